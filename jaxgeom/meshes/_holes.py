"""Filling of holes."""

import jax.numpy as jnp
import numpy as np

from ..shapes import TriangleMesh
from ._halfedges import boundary_walks, ends, host_faces
from ._repair import Repair, clean, orient, split_vertices, weld

# Beyond this the cubic search for the least area gives way to a fan.
_EXACT = 150
# How much the squared sides count beside the area, to choose among equal areas.
_SIDES = 1 / 64
# Area over squared sides below which a triangle has none in single precision.
_FLAT = 1e-6


def fill_holes(
    mesh: TriangleMesh, *, max_edges: int = 64, max_length: float = np.inf
) -> Repair:
    """The mesh with its small boundary loops closed (host).

    Loops of at most `max_edges` edges and of at most `max_length` around are closed by
    the triangulation of least area (a little of the squared sides added, which decides
    among flat ones) whose inner edges are new to the mesh, so that a manifold mesh
    stays one; longer than 150 edges, or where there is none, by a fan
    from a new vertex at their middle (attributes and normals: the mean). The new faces
    are wound like their neighbors: `orient` the mesh first. `holes_left` counts the
    other loops.

    Source: G. Barequet, M. Sharir, Filling gaps in the boundary of a polyhedron, 1995.
    """
    mesh = mesh.trim()
    faces = host_faces(mesh)
    vertices = np.asarray(mesh.vertices)
    loops = [part for x in boundary_walks(faces) for part in _simple_loops(x)]
    loops = [x for x in loops if not _is_a_face(x, faces)]
    small = [x for x in loops if _is_small(vertices[x], max_edges, max_length)]
    known = _edge_keys(*ends(faces), len(vertices))
    patches, fans = [], []
    for loop in small:
        # The hole is seen from the other side of its boundary.
        patch = _least_area(vertices, loop[::-1], known)
        if patch is None:
            fans.append(loop[::-1])
        else:
            patches.append(patch)
            known = np.union1d(known, _edge_keys(*ends(patch), len(vertices)))
    added = [*patches, *_fans(fans, len(vertices))]
    grown = _with_middles(mesh, fans)
    out = np.concatenate([faces, *added]) if added else faces
    filled = TriangleMesh(
        grown.vertices, jnp.asarray(out, jnp.int32), grown.normals, grown.attributes
    )
    return Repair(
        filled,
        filled_holes=len(small),
        holes_left=len(loops) - len(small),
        added_faces=len(out) - len(faces),
        added_vertices=len(fans),
    )


def repair(
    mesh: TriangleMesh,
    *,
    tolerance: float = 0.0,
    max_edges: int = 64,
    max_length: float = np.inf,
) -> Repair:
    """The mesh after `weld`, `clean`, `orient`, `fill_holes`, `split_vertices` (host).

    The settings are those of these functions. Specks are another matter: see
    `drop_small_components`.

        fixed = repair(mesh, tolerance=1e-6)
        print(fixed)
    """
    done = weld(mesh, tolerance=tolerance)
    for step in (clean, orient):
        done = step(done.mesh).after(done)
    done = fill_holes(done.mesh, max_edges=max_edges, max_length=max_length).after(done)
    left = done.holes_left
    # What was filled is closed now, so that outward is well defined.
    for step in (split_vertices, orient):
        done = step(done.mesh).after(done)
    return Repair(done.mesh, **(done.counts() | {"holes_left": left}))


def _simple_loops(loop):
    """The loop, cut where it comes back to one of its vertices."""
    if len(np.unique(loop)) == len(loop):
        return [loop]
    out, path, place = [], [], {}
    for vertex in [*loop.tolist(), int(loop[0])]:
        if vertex in place:
            out.append(np.array(path[place[vertex] :]))
            for left in path[place[vertex] :]:
                del place[left]
            path = path[: path.index(vertex)]
        place[vertex] = len(path)
        path.append(vertex)
    return out


def _is_a_face(loop, faces):
    same = len(loop) == 3 and np.all(np.sort(faces, axis=1) == np.sort(loop), axis=1)
    return len(loop) < 3 or np.any(same)


def _is_small(points, max_edges, max_length):
    around = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum()
    return len(points) <= max_edges and around <= max_length


def _edge_keys(start, end, v):
    low, high = np.minimum(start, end), np.maximum(start, end)
    return np.unique(low.astype(np.int64) * v + high)


def _least_area(vertices, loop, known):
    """Faces [n - 2, 3] over a loop, or None if there are none with new edges.

    cost[i, k] is the least over the part of the loop from i to k, that is over m
    between them of cost[i, m] + cost[m, k] + that of the triangle i m k.
    """
    n = len(loop)
    if n > _EXACT:
        return None
    if n == 3:
        return loop[None]
    points = vertices[loop].astype(np.float64)
    allowed = ~np.isin(_pair_keys(loop, len(vertices)), known)
    cost = np.full((n, n), np.inf)
    cost[np.arange(n - 1), np.arange(1, n)] = 0
    middle = np.zeros((n, n), int)
    for gap in range(2, n):
        i = np.arange(n - gap)
        m = i[:, None] + np.arange(1, gap)
        k = i + gap
        a, b, c = points[i][:, None], points[m], points[k][:, None]
        total = cost[i[:, None], m] + cost[m, k[:, None]] + _cost(a, b, c)
        best = np.argmin(total, axis=1)
        least = total[np.arange(len(i)), best]
        closing = gap == n - 1
        cost[i, k] = np.where(closing | allowed[i, k], least, np.inf)
        middle[i, k] = m[np.arange(len(i)), best]
    if not np.isfinite(cost[0, n - 1]):
        return None
    return loop[_read_back(middle, n)]


def _cost(a, b, c):
    """Area and sides of triangles; infinite for those without area."""
    area = np.linalg.norm(np.cross(b - a, c - a), axis=-1) / 2
    squares = sum(np.sum((x - y) ** 2, axis=-1) for x, y in ((a, b), (b, c), (c, a)))
    return np.where(area > _FLAT * squares, area + _SIDES * squares, np.inf)


def _pair_keys(loop, v):
    low = np.minimum(loop[:, None], loop[None])
    high = np.maximum(loop[:, None], loop[None])
    return low.astype(np.int64) * v + high


def _read_back(middle, n):
    """The triangles (i, m, k) that the table chose."""
    parts, out = [(0, n - 1)], []
    while parts:
        i, k = parts.pop()
        if k - i > 1:
            m = int(middle[i, k])
            out.append((i, m, k))
            parts += [(i, m), (m, k)]
    return np.array(out)


def _fans(loops, v):
    """Faces from a new vertex (v, v + 1, ...) over the edges of each loop."""
    for number, loop in enumerate(loops):
        new = np.full_like(loop, v + number)
        yield np.stack([loop, np.roll(loop, -1), new], axis=-1)


def _with_middles(mesh, loops):
    """The mesh with a vertex more for each loop, the mean of its vertices."""

    def grow(x):
        x = jnp.asarray(x)
        rows = [jnp.mean(x[loop], axis=0, keepdims=True) for loop in loops]
        return jnp.concatenate([x, *[row.astype(x.dtype) for row in rows]])

    normals = None if mesh.normals is None else grow(mesh.normals)
    attributes = {name: grow(x) for name, x in mesh.attributes.items()}
    return TriangleMesh(grow(mesh.vertices), mesh.faces, normals, attributes)
