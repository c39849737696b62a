"""Volume, center and inertia of what a mesh bounds, and of the surface itself."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide
from ..shapes import TriangleMesh
from ._geometry import corners, face_areas


class MassProperties(eqx.Module):
    """A body of density one.

    - `mass`: the volume of a solid (negative if it is inside out), or the area of a
      surface; multiply `mass` and `inertia` by the density for other bodies.
    - `centroid` [3]: the center of mass.
    - `inertia` [3, 3]: the tensor about the centroid, the integral of
      |x|^2 I - x x^T.
    """

    mass: Float[Array, ""]
    centroid: Float[Array, " 3"]
    inertia: Float[Array, "3 3"]


def solid_properties(mesh: TriangleMesh) -> MassProperties:
    """Volume, center and inertia of the solid inside a closed mesh.

    Sums over the tetrahedra from a point o to every face, with
    integral x x^T = det / 120 (sum p p^T + (sum p) (sum p)^T) over their corners p.
    o is the mean of the vertices; of an open mesh these are the properties of the cone
    from there. Differentiable in the vertices. The centroid of a body without volume
    is o, and its inertia zero.

    Source: J. Blow, A. J. Binstock, How to find the inertia tensor of a mesh, 2004.
    """
    triangles, middle = _about_the_middle(mesh)
    a, b, c = (triangles[:, d] for d in range(3))
    six_volumes = jnp.sum(a * jnp.cross(b, c), axis=-1)
    volume = jnp.sum(six_volumes) / 6
    sums = jnp.sum(triangles, axis=1)
    first = jnp.einsum("f,fi->i", six_volumes, sums) / 24
    second = _second_moment(triangles, sums, six_volumes / 120)
    return _about_the_centroid(middle, volume, first, second)


def surface_properties(mesh: TriangleMesh) -> MassProperties:
    """Area, center and inertia of the surface, as of a thin shell.

    Over every face, integral x x^T = area / 12 (sum p p^T + (sum p) (sum p)^T).
    Differentiable in the vertices.
    """
    triangles, middle = _about_the_middle(mesh)
    areas = face_areas(mesh)
    sums = jnp.sum(triangles, axis=1)
    first = jnp.einsum("f,fi->i", areas, sums) / 3
    second = _second_moment(triangles, sums, areas / 12)
    return _about_the_centroid(middle, jnp.sum(areas), first, second)


def _about_the_middle(mesh):
    """Triangles about the mean of the vertices, where fewer digits are lost."""
    real = mesh.vertex_mask[:, None]
    number = jnp.maximum(mesh.num_vertices, 1)
    middle = jnp.sum(jnp.where(real, mesh.vertices, 0), axis=0) / number
    faces = mesh.face_mask[:, None, None]
    return jnp.where(faces, corners(mesh) - middle, 0), middle


def _second_moment(triangles, sums, weights):
    own = jnp.einsum("f,fdi,fdj->ij", weights, triangles, triangles)
    return own + jnp.einsum("f,fi,fj->ij", weights, sums, sums)


def _about_the_centroid(middle, mass, first, second):
    center = safe_divide(first, mass)
    second = second - mass * jnp.outer(center, center)
    inertia = jnp.trace(second) * jnp.eye(3, dtype=second.dtype) - second
    return MassProperties(mass, middle + center, inertia)
