"""Random points on a surface, uniform by area."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import GeometryError, message, safe_normalize
from ..shapes import PointCloud, TriangleMesh
from ._geometry import corners, doubled, face_areas


class SurfaceSamples(eqx.Module):
    """Points on a mesh, with the unit normal of their face and where they lie in it.

    `mask` is False for all samples of a mesh without area: then `faces` is f and the
    rest zero.
    """

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    faces: Int[Array, " n"]
    barycentric: Float[Array, "n 3"]
    mask: Bool[Array, " n"]

    def cloud(self) -> PointCloud:
        """The samples as a point cloud."""
        return PointCloud(self.points, self.normals, self.mask)


def sample_surface(mesh: TriangleMesh, num: int, *, key: Array) -> SurfaceSamples:
    """`num` independent points, uniform by area over the faces.

    A face is drawn with probability proportional to its area, then
    p = (1 - s) a + s (1 - t) b + s t c with s^2, t uniform in [0, 1). Points and
    normals are differentiable in the vertices, for a fixed choice of faces and
    barycentric coordinates. `key` is a typed key, used once. Raises `GeometryError`
    for a negative `num`.

    Source: R. Osada et al., Shape distributions, 2002, section 4.1.
    """
    if num < 0:
        must = "the number of samples must not be negative"
        raise GeometryError(message(must, f"{num}", "Pass num=0 or more."))
    key_face, key_inside = jax.random.split(key)
    dtype = mesh.vertices.dtype
    # Which face is drawn is a discrete choice: it has no gradient.
    areas = jax.lax.stop_gradient(face_areas(mesh))
    uniform = jax.random.uniform(key_face, (num,), dtype)
    faces, found = _draw(areas, mesh.num_faces, uniform)
    s, t = jax.random.uniform(key_inside, (2, num), dtype)
    s = jnp.sqrt(s)
    barycentric = jnp.stack([1 - s, s * (1 - t), s * t], axis=-1)
    barycentric = jnp.where(found[:, None], barycentric, 0)
    triangles = jnp.zeros((num, 3, 3), dtype)
    if mesh.faces.shape[0] > 0:
        triangles = corners(mesh).at[faces].get(mode="fill", fill_value=0)
    points = jnp.einsum("ni,nid->nd", barycentric, triangles)
    normals = safe_normalize(doubled(triangles))
    return SurfaceSamples(points, normals, faces, barycentric, found)


def _draw(areas, num_faces, uniform):
    """Faces drawn in proportion to `areas` [f], and whether there are any."""
    f = areas.shape[0]
    if f == 0:
        none = jnp.zeros(uniform.shape, bool)
        return jnp.zeros(uniform.shape, jnp.int32), none
    areas = jnp.where(jnp.isfinite(areas), areas, 0)
    # The parallel sum may fall by a rounding where faces have no area.
    upto = jax.lax.cummax(jnp.cumsum(areas))
    # The sum at the last real face, not at the end: padding may change its rounding.
    total = upto[jnp.maximum(num_faces, 1) - 1]
    level = jnp.minimum(uniform * total, jnp.nextafter(total, jnp.zeros_like(total)))
    faces = jnp.searchsorted(upto, level, side="right").astype(jnp.int32)
    found = jnp.broadcast_to(total > 0, uniform.shape)
    return jnp.where(found, faces, f), found
