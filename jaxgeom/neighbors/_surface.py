"""The closest point of a triangle mesh."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import RESULTS, check_shape, failure_where, safe_divide, safe_norm
from ..shapes import TriangleMesh
from ._backends import usable
from ._closest import ClosestVisit, face_rows
from ._groups import kd_groups
from ._packets import walk
from ._tree import Tree, child_boxes, grow

_LEAF, _PACKET = 4, 16


class ClosestPoint(eqx.Module):
    """Where on a mesh each query is nearest.

    `points` [q, 3] = sum of `barycentric` [q, 3] times the corners of `faces` [q];
    `mask` is False where the mesh has no face at all or the query is not finite (then
    `faces` is f, `distances` infinite). `result` tells of a mesh without faces.
    """

    points: Float[Array, "q 3"]
    distances: Float[Array, " q"]
    faces: Int[Array, " q"]
    barycentric: Float[Array, "q 3"]
    mask: Bool[Array, " q"]
    result: RESULTS


class SurfaceIndex(eqx.Module):
    """The faces of a mesh prepared for repeated searches.

    Gradients flow through `corners` [f, 3, 3]; `packed` holds them again in the order
    of the tree, as constants, and `visit` what a search reads of them.
    """

    corners: Float[Array, "f 3 3"]
    mask: Bool[Array, " f"]
    tree: Tree
    packed: Float[Array, "3 3 m"]
    visit: ClosestVisit


def index_surface(mesh: TriangleMesh) -> SurfaceIndex:
    """The search structure of a mesh, for more than one call of `closest_on_mesh`."""
    mesh = jax.tree.map(jnp.asarray, mesh)
    corners = mesh.triangles()
    return SurfaceIndex(
        corners, mesh.face_mask, *_plant(jax.lax.stop_gradient(corners), mesh.face_mask)
    )


def closest_on_mesh(
    mesh: TriangleMesh | SurfaceIndex, queries: Float[Array, "q 3"]
) -> ClosestPoint:
    """The exact closest point of the mesh to every query [q, 3].

    Packets of queries that lie together walk a tree of bounding boxes of the faces;
    pass `index_surface(mesh)` to grow it only once. Which face is nearest is a constant
    under differentiation; given the face, the gradient of the distance is the unit
    vector from the closest point to the query, shared among the corners by minus the
    barycentric coordinates (the envelope theorem), and zero on the surface.

    Source: C. Ericson, Real-Time Collision Detection, 2005, 5.1.5 (closest point).
    """
    check_shape("queries", queries, (None, 3))
    index = mesh if isinstance(mesh, SurfaceIndex) else index_surface(mesh)
    corners = index.corners
    queries = jnp.asarray(queries, corners.dtype)
    fixed, live = usable(queries, jnp.ones(queries.shape[0], bool))
    faces = _nearest_faces(jax.lax.stop_gradient(index), fixed, live)
    found = faces < corners.shape[0]
    triangle = corners.at[faces].get(mode="fill", fill_value=0)
    washed = jnp.where(found[:, None], queries, 0)
    weights = jax.vmap(_barycentric)(triangle, washed)
    points = jnp.einsum("qi,qid->qd", weights, triangle)
    # At the minimum the distance does not depend on the weights to first order.
    constant = jax.lax.stop_gradient(weights)
    gap = washed - jnp.einsum("qi,qid->qd", constant, triangle)
    distances = jnp.where(found, safe_norm(gap), jnp.inf)
    result = failure_where(~jnp.any(index.mask), RESULTS.no_surface)
    return ClosestPoint(points, distances, faces, weights, found, result)


@jax.jit
def _plant(corners, mask):
    """The tree of the faces, and their corners in its order."""
    low, high = jnp.min(corners, axis=1), jnp.max(corners, axis=1)
    centers = jnp.mean(corners, axis=1)
    mask = mask & jnp.all(jnp.isfinite(centers), axis=-1)
    centers = jnp.where(mask[:, None], centers, 0)
    tree = grow(kd_groups(centers, mask, _LEAF), low, high)
    packed = corners.at[tree.order].get(mode="fill", fill_value=jnp.inf)
    packed = jnp.moveaxis(packed, 0, -1)
    return tree, packed, ClosestVisit(child_boxes(tree), face_rows(packed, tree.leaf))


# Outside jit, loops would compile what they close over as constants (slowly).
@jax.jit
def _nearest_faces(index, queries, live):
    """The face nearest to each query; f where there is none."""
    tree, leaves = index.tree, index.visit.leaves.shape[0]
    f = index.corners.shape[0]
    start = ClosestVisit.start(live, leaves)
    state = walk(index.visit, queries, kd_groups(queries, live, _PACKET), start)
    slots = ClosestVisit.leaf(state)[:, None] * tree.leaf + jnp.arange(tree.leaf)
    faces = tree.order.at[slots].get(mode="fill", fill_value=f)
    triangles = index.corners.at[faces].get(mode="fill", fill_value=jnp.inf)
    gap = lambda corners, point: point - _barycentric(corners, point) @ corners
    gaps = jax.vmap(jax.vmap(gap, in_axes=(0, None)))(triangles, queries)
    squares = jnp.where(faces < f, jnp.sum(gaps**2, axis=-1), jnp.inf)
    least = jnp.argmin(squares, axis=1)[:, None]
    best = jnp.take_along_axis(faces, least, axis=1)[:, 0]
    return jnp.where(live, jnp.minimum(best, f), f)


def _barycentric(triangle, point):
    return jnp.stack(_weights(*triangle, point, jnp.dot))


def _weights(a, b, c, point, dot):
    """The barycentric coordinates of the closest point of the triangle a b c."""
    ab, ac, bc = b - a, c - a, c - b
    inside_a = 1 - (b_share := _inner_share(ab, ac, point - a, dot))[0] - b_share[1]
    inner = (inside_a, *b_share)
    t_ab = jnp.clip(safe_divide(dot(ab, point - a), dot(ab, ab)), 0, 1)
    t_ac = jnp.clip(safe_divide(dot(ac, point - a), dot(ac, ac)), 0, 1)
    t_bc = jnp.clip(safe_divide(dot(bc, point - b), dot(bc, bc)), 0, 1)
    zero = jnp.zeros_like(t_ab)
    edges = ((1 - t_ab, t_ab, zero), (1 - t_ac, zero, t_ac), (zero, 1 - t_bc, t_bc))
    gaps = (point - a - t_ab * ab, point - a - t_ac * ac, point - b - t_bc * bc)
    square_ab, square_ac, square_bc = (dot(g, g) for g in gaps)
    use_ab = (square_ab <= square_ac) & (square_ab <= square_bc)
    use_ac = square_ac <= square_bc
    within = (inner[0] > 0) & (inner[1] > 0) & (inner[2] > 0)
    pick = lambda i, x, y, z: jnp.where(
        within, i, jnp.where(use_ab, x, jnp.where(use_ac, y, z))
    )
    return tuple(pick(*four) for four in zip(inner, *edges, strict=True))


def _inner_share(ab, ac, ap, dot):
    """The barycentric coordinates of b and c of the foot in the plane; -1 if flat."""
    bb, bc, cc = dot(ab, ab), dot(ab, ac), dot(ac, ac)
    pb, pc = dot(ap, ab), dot(ap, ac)
    area = bb * cc - bc * bc
    # A sliver has no plane in this precision: its edges hold the closest point.
    solid = area > 8 * jnp.finfo(area.dtype).eps * bb * cc
    divide = lambda x: jnp.where(solid, x, -1) / jnp.where(solid, area, 1)
    return divide(cc * pb - bc * pc), divide(bb * pc - bc * pb)
