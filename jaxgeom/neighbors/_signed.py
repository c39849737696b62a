"""The signed distance of a triangle mesh, with a sign right on edges and vertices."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import RESULTS, safe_norm, safe_normalize
from ..shapes import TriangleMesh
from ._surface import ClosestPoint, closest_on_mesh
from ._winding import AbstractWinding, Hierarchical, inside


class SignedDistance(eqx.Module):
    """How far outside (positive) or inside (negative) a mesh every query lies.

    `distances` [q] are infinite where `closest.mask` is False; `normals` [q, 3] are the
    unit pseudonormals at the closest points, zero where the faces around cancel.
    """

    distances: Float[Array, " q"]
    normals: Float[Array, "q 3"]
    closest: ClosestPoint
    result: RESULTS


class AbstractSign(eqx.Module):
    """How inside is told from outside."""

    @abstractmethod
    def is_inside(self, mesh, points, height) -> Bool[Array, " q"]:
        """Where points lie inside; `height` [q] is that over the pseudonormal."""


class Pseudonormal(AbstractSign):
    """The side of the faces around the closest point: for closed, clean meshes."""

    def is_inside(self, mesh, points, height):
        """Below the faces around the closest point."""
        return height < 0


class Winding(AbstractSign):
    """A winding number of more than 1/2: for meshes with holes or crossing parts."""

    method: AbstractWinding = Hierarchical()

    def is_inside(self, mesh, points, height):
        """Where the surface winds around the point."""
        return inside(mesh, points, method=self.method)


def signed_distance(
    mesh: TriangleMesh, points: Float[Array, "q 3"], *, sign: AbstractSign | None = None
) -> SignedDistance:
    """sign((q - c) . n(c)) |q - c|, with c the closest point of the mesh to q [q, 3].

    n(c) is the normal of the face where c lies inside one, the sum of the normals of
    the faces that meet in the edge, and in a vertex the sum weighted by the angles of
    the faces: with these the sign is right wherever c lies on a closed mesh that does
    not cross itself, counter-clockwise seen from outside. Faces meet where they name
    the same vertices: weld the mesh first. On an open mesh the sign tells the side of
    the nearest face: `sign` is `Pseudonormal()` (the default) or `Winding()`.

    Differentiable in points and vertices by the envelope theorem: c minimises the
    distance over the surface, so that to first order only q and the three corners v_i
    of the face move it, at fixed barycentric coordinates b_i,

        d|q - c| = u . (dq - sum b_i dv_i),    u = (q - c) / |q - c|,

    and on the surface itself u is n. Statuses as of `closest_on_mesh`.

    Source: J. A. Baerentzen, H. Aanaes, Signed distance computation using the angle
    weighted pseudonormal, 2005.
    """
    closest = closest_on_mesh(mesh, points)
    # Normals decide between two signs only: they have no gradient.
    still = jax.lax.stop_gradient(mesh)
    normals = _pseudonormals(still, closest.faces, closest.barycentric)
    constant = jax.lax.stop_gradient(closest.barycentric)
    triangle = mesh.triangles().at[closest.faces].get(mode="fill", fill_value=0)
    washed = jnp.where(closest.mask[:, None], points, 0)
    gap = washed - jnp.einsum("qi,qid->qd", constant, triangle)
    height = jnp.sum(normals * gap, axis=-1)
    method = Pseudonormal() if sign is None else sign
    below = method.is_inside(*jax.lax.stop_gradient((mesh, points, height)))
    side = jnp.where(below, -1, 1)
    # Where the gap is rounding error it has no direction: take the normal's.
    size = jnp.maximum(jnp.max(jnp.abs(washed), -1), jnp.max(jnp.abs(triangle), (1, 2)))
    touching = closest.distances <= 4 * jnp.finfo(size.dtype).eps * size
    away = jnp.where(touching, height, side * closest.distances)
    return SignedDistance(away, normals, closest, closest.result)


def _pseudonormals(mesh, faces, barycentric) -> Float[Array, "q 3"]:
    """The unit pseudonormal at points of faces, [q] and [q, 3]."""
    triangles, real = mesh.triangles(), mesh.face_mask[:, None]
    turned = jnp.cross(
        triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    )
    flat = jnp.where(real, safe_normalize(turned), 0)
    pick = lambda x, i: x.at[i].get(mode="fill", fill_value=0)
    zero = barycentric == 0
    corner, side = jnp.argmax(barycentric, axis=1), jnp.argmax(zero, axis=1)
    # The side opposite to corner i starts at corner i + 1.
    edge = pick(_edge_sums(mesh.faces, flat), 3 * faces + (side + 1) % 3)
    own = jnp.take_along_axis(pick(mesh.faces, faces), corner[:, None], axis=1)[:, 0]
    vertex = pick(_vertex_sums(mesh, triangles, flat), own)
    count = jnp.sum(zero, axis=1)[:, None]
    chosen = jnp.where(count == 0, pick(flat, faces), edge)
    return safe_normalize(jnp.where(count == 2, vertex, chosen))


def _edge_sums(faces, normals) -> Float[Array, "e 3"]:
    """The sum of the normals of the faces that share each of the 3f half-edges."""
    start, end = faces.reshape(-1), jnp.roll(faces, -1, axis=1).reshape(-1)
    slots = jnp.arange(start.shape[0], dtype=jnp.int32)
    low, high, slots = jax.lax.sort(
        (jnp.minimum(start, end), jnp.maximum(start, end), slots), num_keys=2
    )
    new = jnp.pad((low[1:] != low[:-1]) | (high[1:] != high[:-1]), (1, 0))
    run = jnp.cumsum(new) - 1
    sums = jax.ops.segment_sum(
        normals[slots // 3], run, slots.shape[0], indices_are_sorted=True
    )
    return jnp.zeros_like(sums).at[slots].set(sums[run])


def _vertex_sums(mesh, triangles, normals) -> Float[Array, "v 3"]:
    """The sum of the normals around each vertex, weighted by angles."""
    ahead = jnp.roll(triangles, -1, axis=1) - triangles
    behind = jnp.roll(triangles, 1, axis=1) - triangles
    sine = safe_norm(jnp.cross(ahead, behind))
    angle = jnp.arctan2(sine, jnp.sum(ahead * behind, axis=-1))
    total = jnp.zeros_like(jnp.asarray(mesh.vertices))
    return total.at[mesh.faces].add(angle[..., None] * normals[:, None], mode="drop")
