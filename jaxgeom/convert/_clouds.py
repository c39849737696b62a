"""From clouds, and to clouds."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from .._core import RESULTS, GeometryError, message, safe_normalize
from ..fields import project
from ..isosurface import Extraction
from ..meshes import sample_surface, vertex_normals
from ..reconstruction import FieldSolution, ScreenedPoisson
from ..shapes import Grid, PointCloud, TriangleMesh
from ._fields import field_to_mesh, grid_to_mesh


def cloud_to_field(cloud: PointCloud, grid: Grid, *, method=None) -> FieldSolution:
    """A field that is zero near the points of an oriented cloud, negative inside.

    `method` is a reconstruction method, `ScreenedPoisson()` by default. A fit, not an
    interpolation: details below the spacing of the grid and the noise of the points are
    lost. Raises `GeometryError` for a cloud without normals; statuses as the method's.
    """
    if cloud.normals is None:
        must = "a field needs a cloud with normals"
        fix = "Call normals.estimate and normals.orient_consistently first."
        raise GeometryError(message(must, "normals=None", fix))
    method = ScreenedPoisson() if method is None else method
    return method(cloud, grid)


def cloud_to_grid(
    cloud: PointCloud, grid: Grid, *, method=None
) -> Float[Array, "x y z"]:
    """`cloud_to_field` as samples [x, y, z] at the nodes, zero on the surface."""
    field = cloud_to_field(cloud, grid, method=method)
    return field.values - field.level


def cloud_to_mesh(cloud: PointCloud, grid: Grid, *, method=None) -> Extraction:
    """The mesh of `cloud_to_field` (host). See `jaxgeom.reconstruct` for raw scans."""
    return grid_to_mesh(cloud_to_grid(cloud, grid, method=method), grid)


def mesh_to_cloud(mesh: TriangleMesh, num: int, *, key: Key[Array, ""]) -> PointCloud:
    """`num` points of the surface, uniform by area, with the normals of their faces.

    The points lie on the mesh exactly; how they are joined is lost. Attributes are
    interpolated. Differentiable in the vertices.
    """
    samples = sample_surface(mesh, num, key=key)
    rows = jnp.asarray(mesh.faces).at[samples.faces]
    rows = rows.get(mode="fill", fill_value=mesh.vertices.shape[0])

    def carry(values):
        corners = jnp.asarray(values).at[rows].get(mode="fill", fill_value=0)
        return jax.vmap(lambda b, x: jnp.tensordot(b, x, 1))(
            samples.barycentric, corners
        )

    attributes = {name: carry(x) for name, x in mesh.attributes.items()}
    return PointCloud(samples.points, samples.normals, samples.mask, attributes)


def vertices_to_cloud(mesh: TriangleMesh) -> PointCloud:
    """The vertices with their normals and attributes: the mesh without its faces.

    Normals that the mesh does not carry are the area-weighted ones of the faces.
    """
    normals = vertex_normals(mesh) if mesh.normals is None else mesh.normals
    return PointCloud(mesh.vertices, normals, mesh.vertex_mask, mesh.attributes)


def field_to_cloud(field, grid: Grid, num: int, *, key: Key[Array, ""]) -> PointCloud:
    """`num` points where a field is zero, with normals along its gradient (host).

    About uniform by area: points are drawn on the mesh of the field over `grid` and
    pulled onto the surface along the gradient. Those that do not arrive are masked out,
    as is all that lies outside of the grid.
    """
    start = mesh_to_cloud(field_to_mesh(field, grid).mesh, num, key=key)
    found = jax.vmap(lambda p: project(field, p))(start.points)
    arrived = found.result == RESULTS.successful
    slopes = jax.vmap(jax.grad(field))(found.point)
    return PointCloud(
        found.point, safe_normalize(slopes), start.mask & arrived
    ).washed()


def grid_to_cloud(
    values: Float[Array, "x y z"], grid: Grid, num: int, *, key: Key[Array, ""]
) -> PointCloud:
    """`num` points of the mesh of zero values, with the normals of its faces (host)."""
    return mesh_to_cloud(grid_to_mesh(values, grid).mesh, num, key=key)
