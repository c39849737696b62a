"""Areas, normals, volume and interpolation, all differentiable in the vertices."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core import check_shape, safe_divide, safe_norm, safe_normalize
from ..shapes import TriangleMesh


def corners(mesh: TriangleMesh) -> Float[Array, "f 3 3"]:
    """The corners of every face, zero for padding, on the device."""
    points = jnp.asarray(mesh.vertices).at[jnp.asarray(mesh.faces)]
    triangles = points.get(mode="fill", fill_value=0)
    return jnp.where(mesh.face_mask[:, None, None], triangles, 0)


def face_normals(mesh: TriangleMesh) -> Float[Array, "f 3"]:
    """The unit normal (b - a) x (c - a) / |...| of every face a b c.

    Zero, with gradient zero, for faces without area and for padding.
    """
    return safe_normalize(doubled(corners(mesh)))


def face_areas(mesh: TriangleMesh) -> Float[Array, " f"]:
    """The area |(b - a) x (c - a)| / 2 of every face; zero for padding.

    The gradient of a face without area is taken as zero.
    """
    return safe_norm(doubled(corners(mesh))) / 2


class AbstractNormalWeights(eqx.Module):
    """How much each face counts for the normals of its three vertices."""

    @abstractmethod
    def at_corners(self, triangles: Float[Array, "f 3 3"]) -> Float[Array, "f 3"]:
        """The weight of every corner of every triangle."""


class AreaWeights(AbstractNormalWeights):
    """Faces count by their area."""

    def at_corners(self, triangles):
        areas = safe_norm(doubled(triangles)) / 2
        return jnp.broadcast_to(areas[:, None], triangles.shape[:2])


class AngleWeights(AbstractNormalWeights):
    """Faces count by their angle at the vertex: independent of the triangulation.

    Source: G. Thuermer, C. A. Wuethrich, Computing vertex normals from polygonal
    facets, 1998.
    """

    def at_corners(self, triangles):
        to_next = jnp.roll(triangles, -1, axis=1) - triangles
        to_last = jnp.roll(triangles, 1, axis=1) - triangles
        sine = safe_norm(jnp.cross(to_next, to_last))
        cosine = jnp.sum(to_next * to_last, axis=-1)
        # atan2(0, 0) has a NaN gradient: a corner without sides has angle zero.
        real = (sine > 0) | (cosine != 0)
        return jnp.where(real, jnp.arctan2(sine, jnp.where(real, cosine, 1)), 0)


class SphereWeights(AbstractNormalWeights):
    """Faces count by sin(angle) / (product of the two sides at the vertex).

    Exact for vertices on a sphere, and most accurate on smooth surfaces.

    Source: N. Max, Weights for computing vertex normals from facet normals, 1999.
    """

    def at_corners(self, triangles):
        to_next = jnp.roll(triangles, -1, axis=1) - triangles
        to_last = jnp.roll(triangles, 1, axis=1) - triangles
        square = lambda x: jnp.sum(x * x, axis=-1)
        # In units of the mesh: products of four lengths would underflow.
        scale = jax.lax.stop_gradient(jnp.max(jnp.abs(to_next), initial=0))
        scale = jnp.where(scale > 0, scale, 1)
        to_next, to_last = to_next / scale, to_last / scale
        sine = safe_norm(jnp.cross(to_next, to_last))
        return safe_divide(sine, square(to_next) * square(to_last))


class UniformWeights(AbstractNormalWeights):
    """All faces count the same."""

    def at_corners(self, triangles):
        return jnp.ones(triangles.shape[:2], triangles.dtype)


def vertex_normals(
    mesh: TriangleMesh, *, weights: AbstractNormalWeights | None = None
) -> Float[Array, "v 3"]:
    """The unit normal of every vertex: normalize(sum over its faces of w n).

    `weights` is `AreaWeights()` (the default), `AngleWeights()`, `SphereWeights()` or
    `UniformWeights()`.
    Zero, with gradient zero, for padding, for vertices without faces and where the
    normals of the faces cancel.
    """
    weights = AreaWeights() if weights is None else weights
    triangles = corners(mesh)
    share = weights.at_corners(triangles)[..., None]
    normals = share * safe_normalize(doubled(triangles))[:, None]
    total = jnp.zeros_like(jnp.asarray(mesh.vertices))
    rows = jnp.where(mesh.face_mask[:, None], mesh.faces, total.shape[0])
    return safe_normalize(total.at[rows].add(normals, mode="drop"))


def area(mesh: TriangleMesh) -> Float[Array, ""]:
    """The area of the surface: the sum of the areas of its faces."""
    return jnp.sum(face_areas(mesh))


def volume(mesh: TriangleMesh) -> Float[Array, ""]:
    """The signed volume inside: sum over faces of (a - o) . (b - o) x (c - o) / 6.

    The divergence theorem; positive where the faces are counter-clockwise seen from
    outside. o is the mean of the vertices, so that a mesh far from the origin loses
    no digits: a closed mesh has the same volume about every o, and for an open one
    this is the volume of the cone from o over the surface.
    """
    triangles = corners(mesh)
    real = mesh.vertex_mask[:, None]
    number = jnp.maximum(mesh.num_vertices, 1)
    center = jnp.sum(jnp.where(real, mesh.vertices, 0), axis=0) / number
    triangles = jnp.where(mesh.face_mask[:, None, None], triangles - center, 0)
    a, b, c = (triangles[:, d] for d in range(3))
    return jnp.sum(a * jnp.cross(b, c)) / 6


def centroid(mesh: TriangleMesh) -> Float[Array, " 3"]:
    """The center of area of the surface: sum A_f (a + b + c) / 3 over sum A_f.

    Zero for a mesh without area.
    """
    areas = face_areas(mesh)
    middles = jnp.mean(corners(mesh), axis=1)
    return safe_divide(jnp.sum(areas[:, None] * middles, axis=0), jnp.sum(areas))


def interpolate(
    mesh: TriangleMesh,
    attribute: Float[Array, "v *d"],
    face: Int[Array, " q"],
    barycentric: Float[Array, "q 3"],
) -> Float[Array, "q *d"]:
    """The values b_0 x_i + b_1 x_j + b_2 x_k of `attribute` on the faces (i, j, k).

    `attribute` [v, ...] lies on the vertices (`mesh.vertices` itself gives points),
    `face` [q] names faces, `barycentric` [q, 3] are the coordinates in them. Zero for
    faces that do not exist (index f) and for padding.
    """
    check_shape("attribute", attribute, (mesh.vertices.shape[0], *attribute.shape[1:]))
    check_shape("barycentric", barycentric, (face.shape[0], 3))
    f = mesh.faces.shape[0]
    v = mesh.vertices.shape[0]
    faces = jnp.where(mesh.face_mask[:, None], mesh.faces, v)
    rows = faces.at[jnp.where(face < 0, f, face)].get(mode="fill", fill_value=v)
    values = jnp.asarray(attribute).at[rows].get(mode="fill", fill_value=0)
    return jax.vmap(lambda b, x: jnp.tensordot(b, x, 1))(barycentric, values)


def doubled(triangles):
    """The normals of triangles [*, 3, 3], twice their areas long."""
    a, b, c = (triangles[..., d, :] for d in range(3))
    return jnp.cross(b - a, c - a)
