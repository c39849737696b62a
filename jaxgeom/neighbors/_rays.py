"""Where rays first meet a triangle mesh."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import RESULTS, check_shape, failure_where, safe_divide, safe_normalize
from ..shapes import TriangleMesh
from ._backends import usable
from ._groups import kd_groups
from ._packets import AbstractVisit, walk
from ._surface import SurfaceIndex, index_surface

# Rays part sooner than points: fewer to a packet.
_PACKET = 8
# Channels of a ray: origin, direction, one over it, slack.
_ORIGIN, _WAY, _OVER, _SLACK = slice(0, 3), slice(3, 6), slice(6, 9), 9


class RayHits(eqx.Module):
    """The first face that every ray meets.

    `points` [q, 3] = origin + `t` [q] * direction = sum of `barycentric` [q, 3] times
    the corners of `faces` [q], with the unit `normals` [q, 3] of these faces. `mask` is
    False where a ray meets nothing, is not finite or has no direction: then `t` is
    infinite, `faces` is f and the rest zero. `result` tells of a mesh without faces.
    """

    t: Float[Array, " q"]
    points: Float[Array, "q 3"]
    faces: Int[Array, " q"]
    barycentric: Float[Array, "q 3"]
    normals: Float[Array, "q 3"]
    mask: Bool[Array, " q"]
    result: RESULTS


class RayVisit(AbstractVisit):
    """Keeps the least t so far and the leaf where it was found (as `ClosestVisit`)."""

    inner: Float[Array, "h 12"]
    leaves: Float[Array, "l w"]

    def wanted(self, row, query, state):
        """Children that the ray enters before its first hit so far."""
        left, right = (
            _entry(row[0:3], row[3:6], query),
            _entry(row[6:9], row[9:], query),
        )
        one, two = left <= state[0], right <= state[0]
        one, two = one & (left < jnp.inf), two & (right < jnp.inf)
        return one, two, (one | two) & (right < left)

    def taken(self, row, leaf, query, state):
        """The first hit after the faces of a leaf."""
        best, seen, found, last = state
        found = jnp.where(best < seen, last, found)
        new = best
        for start in range(0, len(row), 9):
            t = _first(row[start : start + 9], query)
            new = jnp.where(t < new, t, new)
        return new, best, found, jnp.broadcast_to(leaf, found.shape)


def cast_rays(
    mesh: TriangleMesh | SurfaceIndex,
    origins: Float[Array, "q 3"],
    directions: Float[Array, "q 3"],
) -> RayHits:
    """The first point of the mesh on every ray: the least t >= 0 with

        origin + t * direction = b_0 v_0 + b_1 v_1 + b_2 v_2,  b_i >= 0.

    `origins` [q, 3] in the unit of the mesh, `directions` [q, 3] of any length but
    zero (t is in their unit). Both sides of faces count. Edges and corners belong to
    all their faces, with the rounding error of the test as margin, so that no ray slips
    through a closed mesh (and a border is that much wider). Faces seen from the edge
    are not hit. `t`, the points and the barycentric coordinates are differentiable in
    the vertices, origins and directions, for a fixed choice of the face:
    t = n . (v_0 - origin) / (n . direction). Pass `index_surface(mesh)` for repeated
    calls. Status `no_surface` for a mesh without faces.

    Source: T. Moeller, B. Trumbore, Fast, minimum storage ray/triangle intersection,
    1997; S. Woop et al., Watertight ray/triangle intersection, 2013 (edge functions).
    """
    check_shape("origins", origins, (None, 3))
    check_shape("directions", directions, (origins.shape[0], 3))
    index = mesh if isinstance(mesh, SurfaceIndex) else index_surface(mesh)
    dtype, f = index.corners.dtype, index.corners.shape[0]
    origins, ways = jnp.asarray(origins, dtype), jnp.asarray(directions, dtype)
    fixed, live = usable(
        jnp.concatenate([origins, ways], axis=1), jnp.ones(origins.shape[0], bool)
    )
    live = live & jnp.any(fixed[:, 3:] != 0, axis=-1)
    faces = _first_faces(*jax.lax.stop_gradient((index, fixed)), live)
    found = faces < f
    triangle = index.corners.at[faces].get(mode="fill", fill_value=0)
    wash = lambda x: jnp.where(found[:, None], x, 0)
    t, barycentric, normals = jax.vmap(_meeting)(triangle, wash(origins), wash(ways))
    points = jnp.einsum("qi,qid->qd", barycentric, triangle)
    result = failure_where(~jnp.any(index.mask), RESULTS.no_surface)
    return RayHits(
        jnp.where(found, t, jnp.inf),
        wash(points),
        faces,
        wash(barycentric),
        wash(normals),
        found,
        result,
    )


def _meeting(triangle, origin, way):
    """Where a ray meets the plane of a triangle that it is known to meet."""
    a, b, c = triangle
    normal = jnp.cross(b - a, c - a)
    t = safe_divide(normal @ (a - origin), normal @ way)
    # Behind the origin by rounding only; the derivative is that of the plane.
    t = t + jax.lax.stop_gradient(jnp.maximum(t, 0) - t)
    sides = ((b, c - b), (c, a - c), (a, b - a))
    shares = [jnp.cross(x - origin, side) @ way for x, side in sides]
    total = shares[0] + shares[1] + shares[2]
    barycentric = jnp.stack([safe_divide(x, total) for x in shares])
    # The margin of the test: outside by rounding is on the border.
    inner = jnp.maximum(jax.lax.stop_gradient(barycentric), 0)
    inner = inner / jnp.maximum(jnp.sum(inner), 1)
    barycentric = barycentric + jax.lax.stop_gradient(inner - barycentric)
    return t, barycentric, safe_normalize(normal)


# Outside jit, loops would compile what they close over as constants (slowly).
@jax.jit
def _first_faces(index, rays, live):
    """The face that each ray [6] meets first; f where there is none."""
    tree, leaves = index.tree, index.visit.leaves.shape[0]
    f, q = index.corners.shape[0], rays.shape[0]
    queries = _channels(index, rays)
    rows = jnp.moveaxis(index.packed, -1, 0).reshape(-1, tree.leaf * 9)
    visit = RayVisit(index.visit.inner, rows)
    blank = jnp.full(q, leaves, jnp.int32)
    start = jnp.where(live, jnp.inf, -jnp.inf).astype(rays.dtype)
    groups = _together(index, queries, live)
    state = walk(visit, queries, groups, (start, start, blank, blank))
    best, seen, leaf, last = state
    leaf = jnp.where(best < seen, last, leaf)
    slots = leaf[:, None] * tree.leaf + jnp.arange(tree.leaf)
    faces = tree.order.at[slots].get(mode="fill", fill_value=f)
    corners = index.corners.at[faces].get(mode="fill", fill_value=jnp.inf)
    flat = [corners[:, :, i, d] for i in range(3) for d in range(3)]
    t = _first(flat, [x[:, None] for x in queries.T])
    # The leaf holds a hit, though rounding may differ here: then the nearest to it.
    t = jnp.where(jnp.isfinite(t), t, jnp.where(faces < f, jnp.finfo(t.dtype).max, t))
    pick = jnp.argmin(t, axis=1)[:, None]
    chosen = jnp.take_along_axis(faces, pick, axis=1)[:, 0]
    return jnp.where(live & (leaf < leaves), chosen, f)


def _channels(index, rays):
    """What the tests read of rays; directions have largest entry 1."""
    origins, ways = rays[:, :3], rays[:, 3:]
    peak = jnp.max(jnp.abs(ways), axis=1, keepdims=True)
    ways = ways / jnp.where(peak > 0, peak, 1)
    least = jnp.asarray(jnp.finfo(rays.dtype).eps ** 3, rays.dtype)
    safe = jnp.where(jnp.abs(ways) < least, jnp.where(ways < 0, -least, least), ways)
    size = jnp.max(jnp.where(index.mask[:, None, None], jnp.abs(index.corners), 0))
    size = jnp.maximum(size, jnp.max(jnp.abs(origins), axis=1, keepdims=True))
    slack = 8 * jnp.finfo(rays.dtype).eps * size
    return jnp.concatenate([origins, ways, 1 / safe, slack], axis=1)


def _together(index, queries, live):
    """Groups of rays that run alike: near each other in six dimensions, origins in
    units of the size of the mesh."""
    corners = jnp.where(index.mask[:, None, None], index.corners, 0)
    size = jnp.max(jnp.ptp(corners, axis=(0, 1)))
    size = jnp.where(size > 0, size, 1)
    places = jnp.concatenate([queries[:, _ORIGIN] / size, queries[:, _WAY]], axis=1)
    return kd_groups(places, live, _PACKET)


def _entry(low, high, ray):
    """The t where a ray enters a box; infinite where it misses it."""
    origin, over, slack = ray[_ORIGIN], ray[_OVER], ray[_SLACK]
    near, far = 0.0, jnp.inf
    for d in range(3):
        ahead = over[d] > 0
        first = jnp.where(ahead, low[d] - slack, high[d] + slack) - origin[d]
        last = jnp.where(ahead, high[d] + slack, low[d] - slack) - origin[d]
        enter, leave = first * over[d], last * over[d]
        near = jnp.where(enter > near, enter, near)
        far = jnp.where(leave < far, leave, far)
    return jnp.where(near <= far, near, jnp.inf)


def _first(face, ray):
    """The t where a ray meets a face; infinite where it does not."""
    origin, way = ray[_ORIGIN], ray[_WAY]
    a, b, c = ([face[3 * i + d] - origin[d] for d in range(3)] for i in range(3))
    dot = lambda x, y: x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    cross = lambda x, y: [
        x[1] * y[2] - x[2] * y[1],
        x[2] * y[0] - x[0] * y[2],
        x[0] * y[1] - x[1] * y[0],
    ]
    minus = lambda x, y: [p - q for p, q in zip(x, y, strict=True)]
    ab, bc, ca = minus(b, a), minus(c, b), minus(a, c)
    edges = [dot(cross(x, y), way) for x, y in ((b, bc), (c, ca), (a, ab))]
    # At least six times the rounding error of a product of place, edge and way.
    size = lambda *vectors: sum(jnp.abs(x) for vector in vectors for x in vector)
    margin = jnp.finfo(a[0].dtype).eps * size(a, b, c) * size(ab, bc, ca)
    one_way = (edges[0] >= -margin) & (edges[1] >= -margin) & (edges[2] >= -margin)
    other = (edges[0] <= margin) & (edges[1] <= margin) & (edges[2] <= margin)
    normal = cross(ab, bc)
    slope = dot(normal, way)
    length = jnp.sqrt(dot(normal, normal))
    # A face seen from the edge: its neighbors are hit instead.
    solid = jnp.abs(slope) > 4 * jnp.finfo(length.dtype).eps * length
    t = dot(normal, a) / jnp.where(solid, slope, 1)
    t = jnp.where(jnp.abs(t) <= ray[_SLACK], jnp.abs(t), t)
    return jnp.where((one_way | other) & solid & (t >= 0), t, jnp.inf)
