"""Surfaces trimmed by polygons in the plane of their parameters."""

import numpy as np

from .._core import GeometryError, message
from ..shapes import TriangleMesh
from ._abstract import AbstractSurface
from ._tessellate import mesh_of

_ROUNDS = 64
# A grid node keeps this part of a cell away from the border, so that angles stay open.
_CLEAR = 0.5
_SHARP = np.cos(np.deg2rad(60))


def tessellate_trimmed(
    surface: AbstractSurface, loops, resolution: tuple[int, int] = (32, 32)
) -> TriangleMesh:
    """The mesh of the part of a surface inside loops of its parameter plane.

    Cells of about the size of `resolution` over the domain fill the inside; they end on
    the loops exactly: every edge of the boundary lies on a side of a polygon, and every
    corner of a polygon is a vertex. The result is a manifold with one boundary loop for
    each polygon, oriented as the surface. Seams and poles are not glued.

    **Arguments:**

    - `loops`: polygons [k, 2] of (u, v) within the domain, in either direction, that
      do not meet. Inside is what an odd number of them encloses: the first may be
      the outline, the others holes.

    The mesh carries the attribute `uv`; it is planned on the host (numpy and scipy) and
    differentiable in the parameters of the surface. Raises `GeometryError` for loops
    that leave the domain, cross or touch, and for sides too close to be resolved.

    Source: J. Ruppert, A Delaunay refinement algorithm for quality 2-dimensional mesh
    generation, 1995 (here until all sides are edges).
    """
    domain = surface.domain()
    low = np.array([domain.u.low, domain.v.low])
    size = np.array([domain.u.length, domain.v.length])
    cell = size / np.asarray(resolution)
    polygons = [_checked(loop, domain) / cell for loop in loops]
    if not polygons:
        _refuse("trimming needs at least one loop", "none", "Use tessellate.")
    uv, faces = _conforming(polygons, low / cell)
    # Rounding must not carry a corner out of the domain.
    uv = np.clip(uv * cell, low, low + size)
    return mesh_of(surface, uv, faces.astype(np.int32))


def inside_loops(points, loops) -> np.ndarray:
    """Whether points [n, 2] are enclosed by an odd number of polygons (host)."""
    points = np.asarray(points, float)
    start, end = _sides([np.asarray(loop, float) for loop in loops])
    return _odd(points, start, end)


def _conforming(polygons, origin):
    """Points [v, 2] and faces of the inside, in units of cells."""
    start, end = _sides(polygons)
    _check_apart(start, end)
    points = np.concatenate(polygons)
    segments = _ring_indices(polygons)
    corner = _sharp_corners(polygons)
    points, segments = _divided(points, segments)
    grid = _grid_around(points, origin)
    for _ in range(_ROUNDS):
        free = grid[_distance(grid, points[segments]) > _clearance(points, segments)]
        every = np.concatenate([points, free])
        triangles = _delaunay(every)
        missing = ~_present(segments, triangles, len(every))
        if not missing.any():
            return _inside_part(every, triangles, start, end)
        points, segments = _split_sides(points, segments, missing, corner)
    given = f"{int(missing.sum())} sides unresolved after {_ROUNDS} divisions"
    _refuse("sides of loops must be resolvable", given, "Move close sides apart.")


def _inside_part(points, triangles, start, end):
    inside = _odd(points[triangles].mean(axis=1), start, end)
    faces = triangles[inside]
    a, b, c = (points[faces[:, i]] for i in range(3))
    wrong = _cross(b - a, c - a) < 0
    faces = np.where(wrong[:, None], faces[:, ::-1], faces)
    used, numbers = np.unique(faces, return_inverse=True)
    return points[used], numbers.reshape(-1, 3)


def _delaunay(points):
    from scipy.spatial import Delaunay

    return Delaunay(points).simplices


def _grid_around(points, origin):
    """The nodes of the unit grid around the points, two cells beyond all sides."""
    first = np.floor(points.min(axis=0) - origin) - 2
    last = np.ceil(points.max(axis=0) - origin) + 2
    axes = [np.arange(a, b + 1) for a, b in zip(first, last, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    return nodes + origin


def _divided(points, segments):
    """Sides cut evenly to lengths of at most about one cell."""
    a, b = points[segments[:, 0]], points[segments[:, 1]]
    pieces = np.maximum(np.rint(np.linalg.norm(b - a, axis=1)), 1).astype(int)
    side = np.repeat(np.arange(len(segments)), pieces - 1)
    first = np.concatenate([[0], np.cumsum(pieces - 1)])
    step = np.arange(len(side)) - first[side] + 1
    share = (step / pieces[side])[:, None]
    middle = (1 - share) * a[side] + share * b[side]
    number = len(points) + np.arange(len(side))
    chain = np.concatenate([segments[:, 0], number])
    order = np.lexsort(
        [np.concatenate([np.zeros(len(segments)), step]), _owner(segments, side)]
    )
    chain = chain[order]
    last = np.append(np.flatnonzero(np.diff(_owner(segments, side)[order])), -1)
    ends = np.roll(chain, -1)
    ends[last] = segments[:, 1]
    return np.concatenate([points, middle]), np.stack([chain, ends], axis=1)


def _owner(segments, side):
    return np.concatenate([np.arange(len(segments)), side])


def _split_sides(points, segments, which, corner):
    """The sides `which` halved; at a sharp corner on circles around it, so that two
    sides of the corner are cut at equal distances and do not chase each other."""
    a, b = segments[which].T
    length = np.linalg.norm(points[b] - points[a], axis=1)
    is_corner = lambda i: np.isin(i, corner)
    shell = 2.0 ** np.rint(np.log2(length / 2)) / length
    share = np.where(is_corner(a) & ~is_corner(b), shell, 0.5)
    share = np.where(is_corner(b) & ~is_corner(a), 1 - shell, share)[:, None]
    middle = (1 - share) * points[a] + share * points[b]
    number = len(points) + np.arange(len(a))
    halves = [np.stack([a, number], axis=1), np.stack([number, b], axis=1)]
    kept = segments[~which]
    return np.concatenate([points, middle]), np.concatenate([kept, *halves])


def _present(segments, triangles, number):
    edges = np.concatenate(
        [triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]
    )
    key = lambda pairs: np.sort(pairs, axis=1) @ np.array([number, 1])
    return np.isin(key(segments), key(edges))


def _clearance(points, segments):
    """Half the longest side, at most a part of a cell."""
    ends = points[segments]
    return min(_CLEAR, 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max())


def _distance(points, sides, chunk=4096):
    """The distance of every point to the nearest side."""
    start, along = sides[:, 0], sides[:, 1] - sides[:, 0]
    square = np.sum(along**2, axis=1)
    parts = [
        _least_distance(points[k : k + chunk], start, along, square)
        for k in range(0, len(points), chunk)
    ]
    return np.concatenate(parts)


def _least_distance(points, start, along, square):
    gap = points[:, None] - start
    share = np.clip(np.sum(gap * along, axis=-1) / square, 0, 1)
    return np.linalg.norm(gap - share[..., None] * along, axis=-1).min(axis=1)


def _odd(points, start, end):
    """Whether a ray to the right of every point crosses an odd number of sides."""
    x, y = points.T[:, :, None]
    above = (start[:, 1] > y) != (end[:, 1] > y)
    rise = end[:, 1] - start[:, 1]
    share = (y - start[:, 1]) / np.where(rise == 0, 1, rise)
    right = start[:, 0] + share * (end[:, 0] - start[:, 0]) > x
    return np.sum(above & right, axis=1) % 2 == 1


def _sides(polygons):
    start = np.concatenate(polygons)
    return start, np.concatenate([np.roll(p, -1, axis=0) for p in polygons])


def _ring_indices(polygons):
    sizes = [len(p) for p in polygons]
    first = np.concatenate([[0], np.cumsum(sizes)])[:-1]
    rings = [k + np.arange(n) for k, n in zip(first, sizes, strict=True)]
    return np.concatenate([np.stack([r, np.roll(r, -1)], axis=1) for r in rings])


def _sharp_corners(polygons):
    """The numbers of corners of less than 60 degrees."""
    unit = lambda x: x / np.linalg.norm(x, axis=1, keepdims=True)
    ahead = np.concatenate([unit(np.roll(p, -1, axis=0) - p) for p in polygons])
    behind = np.concatenate([unit(np.roll(p, 1, axis=0) - p) for p in polygons])
    return np.flatnonzero(np.sum(ahead * behind, axis=1) > _SHARP)


def _checked(loop, domain):
    loop = np.asarray(loop, float)
    if loop.ndim != 2 or loop.shape[1] != 2 or len(loop) < 3:
        _refuse("a loop must have shape [k, 2], k > 2", f"{loop.shape}", "Reshape it.")
    low, high = (domain.u.low, domain.v.low), (domain.u.high, domain.v.high)
    if not ((loop >= low) & (loop <= high)).all():
        given = f"from {loop.min(axis=0)} to {loop.max(axis=0)}"
        _refuse(f"a loop must lie within {low} to {high}", given, "Clip or move it.")
    if (loop == np.roll(loop, 1, axis=0)).all(axis=1).any():
        _refuse("corners must differ", "two equal ones in a row", "Drop one.")
    return loop


def _check_apart(start, end):
    """Raise unless sides meet at most at a corner they share."""
    n = len(start)
    i, j = np.triu_indices(n, 1)
    a, b, c, d = start[i], end[i], start[j], end[j]
    joined = (b == c).all(axis=1) | (d == a).all(axis=1)
    turn = lambda p, q, r: np.sign(_cross(q - p, r - p))
    apart = (turn(a, b, c) * turn(a, b, d) > 0) | (turn(c, d, a) * turn(c, d, b) > 0)
    left = np.maximum(a, b) < np.minimum(c, d)
    right = np.maximum(c, d) < np.minimum(a, b)
    meets = ~joined & ~apart & ~(left | right).any(axis=1)
    # Two sides at a common corner may not run back over each other.
    back = joined & (turn(a, b, c) == 0) & (turn(a, b, d) == 0)
    back &= np.sum((b - a) * (d - c), axis=1) < 0
    if (meets | back).any():
        k = int(np.argmax(meets | back))
        must = "sides of loops must not cross or touch"
        _refuse(must, f"sides {i[k]} and {j[k]} meet", "Separate or merge the loops.")


def _cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _refuse(must, given, fix):
    raise GeometryError(message(must, given, fix))
