"""To parametric surfaces: NURBS fitted to sheets."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide
from ..clouds import oriented_box
from ..meshes import disc_parameters
from ..parametric import NurbsFit, SplineBasis, fit_surface
from ..shapes import Grid, PointCloud, PolygonMesh, TriangleMesh
from ._fields import field_to_mesh, grid_to_mesh
from ._polygons import polygons_to_mesh


def mesh_to_surface(
    mesh: TriangleMesh,
    num_control: tuple[int, int] = (12, 12),
    *,
    degree: int = 3,
    smoothing: float = 1e-6,
) -> NurbsFit:
    """A NURBS surface near the vertices of a disc, over the unit square (host).

    The vertices get their parameters from `meshes.disc_parameters`, then the surface is
    that of `parametric.fit_surface` over clamped bases with `num_control` control
    points along u and v. Its normal points to the side of the mesh's. A fit: `rmse`
    tells how near, in the unit of the vertices; `parametric.refine_fit` improves it.

    `smoothing` keeps the control points determined where there are few vertices.
    Differentiable in nothing: the parameters are found on the host. **Statuses** as of
    `fit_surface`. Raises `GeometryError` for what is no disc; cut closed meshes open.
    """
    mesh = mesh.trim()
    return _fitted(mesh.vertices, disc_parameters(mesh), num_control, degree, smoothing)


def polygons_to_surface(
    mesh: PolygonMesh, num_control: tuple[int, int] = (12, 12), **settings
) -> NurbsFit:
    """`mesh_to_surface` of a disc of polygons (host)."""
    return mesh_to_surface(polygons_to_mesh(mesh), num_control, **settings)


def cloud_to_surface(
    cloud: PointCloud,
    num_control: tuple[int, int] = (12, 12),
    *,
    degree: int = 3,
    smoothing: float = 1e-6,
) -> NurbsFit:
    """A NURBS surface near the points of a sheet that can be seen from one side.

    The points are looked at along the shortest side of `clouds.oriented_box`, on which
    no two parts of the sheet may lie over each other; u and v are their places from 0
    to 1 along the two others. Where the box has no points the surface only goes on
    smoothly. Its normal points to the side of the cloud's normals, if it has any.
    Settings, **statuses** and derivatives as of `parametric.fit_surface`; padding takes
    no part.
    """
    clean = cloud.washed()
    box = jax.lax.stop_gradient(oriented_box(clean))
    order = jnp.argsort(box.half_extents)
    across, second, first = box.axes.T[order]
    # A right-handed frame whose third axis points outward.
    outward = across if clean.normals is None else jnp.sum(clean.normals, axis=0)
    second = second * jnp.where(jnp.dot(jnp.cross(first, second), outward) < 0, -1, 1)
    local = (clean.points - box.center) @ jnp.stack([first, second], axis=1)
    uv = safe_divide(local, 2 * box.half_extents[order[:0:-1]]) + 0.5
    uv = jax.lax.stop_gradient(jnp.where(clean.mask[:, None], uv, 0))
    weights = clean.mask.astype(clean.points.dtype)
    return _fitted(clean.points, uv, num_control, degree, smoothing, weights)


def grid_to_surface(
    values: Float[Array, "x y z"],
    grid: Grid,
    num_control: tuple[int, int] = (12, 12),
    **settings,
) -> NurbsFit:
    """`mesh_to_surface` where values at the nodes are zero (host): a sheet that leaves
    the grid all around."""
    return mesh_to_surface(grid_to_mesh(values, grid).mesh, num_control, **settings)


def field_to_surface(
    field: Callable, grid: Grid, num_control: tuple[int, int] = (12, 12), **settings
) -> NurbsFit:
    """`mesh_to_surface` where a field is zero inside of a grid (host)."""
    return mesh_to_surface(field_to_mesh(field, grid).mesh, num_control, **settings)


def _fitted(points, uv, num_control, degree, smoothing, weights=None):
    bases = tuple(SplineBasis.clamped(n, degree) for n in num_control)
    uv = jnp.asarray(uv, jnp.result_type(points, float))
    settings = {"parameters": uv, "weights": weights, "smoothing": smoothing}
    return fit_surface(points, bases, **settings)
