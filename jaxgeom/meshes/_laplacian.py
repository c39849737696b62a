"""Laplace operators and mass of the vertices."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide, safe_norm
from ..shapes import TriangleMesh
from ._edge_list import edges
from ._geometry import corners, doubled
from ._sparse import SparseOperator
from ._topology import proper_faces


def cotangents(triangles: Float[Array, "f 3 3"]) -> Float[Array, "f 3"]:
    """The cotangent of the angle at every corner: u . w / |u x w|.

    Zero, with gradient zero, for triangles without area.
    """
    to_next = jnp.roll(triangles, -1, axis=1) - triangles
    to_last = jnp.roll(triangles, 1, axis=1) - triangles
    twice = safe_norm(doubled(triangles))
    return safe_divide(jnp.sum(to_next * to_last, axis=-1), twice[:, None])


def cotangent_laplacian(mesh: TriangleMesh) -> SparseOperator:
    """L with x . L x = the integral of |grad x|^2 over the surface.

    (L x)_i = sum over edges ij of (cot a_ij + cot b_ij) / 2 (x_i - x_j), with the
    angles opposite to the edge; symmetric, positive semidefinite, L 1 = 0. Linear
    functions on a flat mesh have L x = 0 inside. With the masses M of `lumped_mass`,
    -M^-1 L is the Laplace-Beltrami operator.

    Source: U. Pinkall, K. Polthier, Computing discrete minimal surfaces, 1993.
    """
    v = mesh.vertices.shape[0]
    faces = jnp.where(proper_faces(mesh)[:, None], mesh.faces, v)
    weights = cotangents(corners(mesh)) / 2
    start = jnp.roll(faces, -1, axis=1).reshape(-1)
    end = jnp.roll(faces, -2, axis=1).reshape(-1)
    return _from_weights(start, end, weights.reshape(-1), v)


def uniform_laplacian(mesh: TriangleMesh) -> SparseOperator:
    """L with (L x)_i = sum over the neighbors j of i of (x_i - x_j).

    The degree matrix minus the adjacency matrix: symmetric, positive semidefinite,
    L 1 = 0; the geometry does not count.
    """
    v = mesh.vertices.shape[0]
    found = edges(mesh)
    weights = found.mask.astype(mesh.vertices.dtype)
    return _from_weights(found.vertices[:, 0], found.vertices[:, 1], weights, v)


def _from_weights(start, end, weights, v):
    """sum over the pairs of w (e_i - e_j) (e_i - e_j)^T."""
    diagonal = jnp.zeros(v, weights.dtype)
    diagonal = diagonal.at[start].add(weights, mode="drop")
    diagonal = diagonal.at[end].add(weights, mode="drop")
    own = jnp.arange(v, dtype=jnp.int32)
    return SparseOperator(
        jnp.concatenate([start, end, own]),
        jnp.concatenate([end, start, own]),
        jnp.concatenate([-weights, -weights, diagonal]),
        (v, v),
    )


class AbstractVertexAreas(eqx.Module):
    """How the area of a face is shared among its corners."""

    @abstractmethod
    def at_corners(self, triangles: Float[Array, "f 3 3"]) -> Float[Array, "f 3"]:
        """The area of the part of every corner."""


class BarycentricAreas(AbstractVertexAreas):
    """A third for each corner."""

    def at_corners(self, triangles):
        areas = safe_norm(doubled(triangles)) / 2
        return jnp.broadcast_to(areas[:, None] / 3, triangles.shape[:2])


class MixedVoronoiAreas(AbstractVertexAreas):
    """The part nearest to each corner; 1/2, 1/4, 1/4 where an angle is obtuse.

    Source: M. Meyer et al., Discrete differential-geometry operators for triangulated
    2-manifolds, 2003, section 3.3.
    """

    def at_corners(self, triangles):
        areas = safe_norm(doubled(triangles)) / 2
        sides = triangles - jnp.roll(triangles, -1, axis=1)
        cot = cotangents(triangles)
        # The side from corner d to d + 1 is opposite to corner d + 2.
        share = jnp.sum(sides**2, axis=-1) * jnp.roll(cot, -2, axis=1) / 8
        nearest = share + jnp.roll(share, 1, axis=1)
        obtuse = cot < 0
        blunt = jnp.where(obtuse, areas[:, None] / 2, areas[:, None] / 4)
        return jnp.where(jnp.any(obtuse, axis=1, keepdims=True), blunt, nearest)


def lumped_mass(
    mesh: TriangleMesh, *, areas: AbstractVertexAreas | None = None
) -> Float[Array, " v"]:
    """The area that belongs to every vertex; the sum is the area of the surface.

    `areas` is `BarycentricAreas()` (the default) or `MixedVoronoiAreas()`. Zero for
    padding and for vertices without faces.
    """
    areas = BarycentricAreas() if areas is None else areas
    return sum_at_vertices(mesh, areas.at_corners(corners(mesh)))


def sum_at_vertices(mesh: TriangleMesh, values: Float[Array, "f 3 *d"]):
    """The sum over the corners at every vertex of `values` [f, 3, ...]."""
    v = mesh.vertices.shape[0]
    faces = jnp.where(mesh.face_mask[:, None], mesh.faces, v)
    total = jnp.zeros((v, *values.shape[2:]), values.dtype)
    return total.at[faces].add(values, mode="drop")
