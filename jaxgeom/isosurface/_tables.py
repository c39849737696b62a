"""The case table of marching cubes, derived from the loops of the cube.

Loops are cut into triangles, or joined in pairs by a tube of triangles where the
interpolant runs through the cell. Diagonals keep out of the cube faces if they can: the
neighbor cell might use the same diagonal, and an edge would have four faces. Some long
loops and tubes cannot, so every diagonal of a face belongs to one of its two cells.
"""

import functools
import itertools
from typing import NamedTuple

import numpy as np

from ._cube import Edge, ambiguous_faces, edge, edges, faces, loops

CODE_BITS = 5
_FORBIDDEN = 10**6
_IN_FACE = 100


def triangulate(loop: tuple[Edge, ...]) -> tuple[tuple[Edge, Edge, Edge], ...]:
    """The triangles of a loop: the shortest ones of which none lies in a cube face.

    The polygon from corner i to corner j is best cut by the triangle (i, k, j) that
    makes the sum over both rests smallest.
    """
    n = len(loop)
    cost = _cost_within(loop)

    @functools.cache
    def best(i, j):
        if j - i < 2:
            return 0, ()
        own = 0 if (i, j) == (0, n - 1) else cost(loop[i], loop[j])
        options = []
        for k in range(i + 1, j):
            (left, cut_left), (right, cut_right) = best(i, k), best(k, j)
            flat = _FORBIDDEN if _faces_of(loop[i], loop[k], loop[j]) else 0
            options.append((flat + left + right, (*cut_left, (i, k, j), *cut_right)))
        total, cut = min(options)
        return own + total, cut

    return tuple((loop[i], loop[j], loop[k]) for i, j, k in best(0, n - 1)[1])


def tube(a: tuple[Edge, ...], b: tuple[Edge, ...]):
    """The triangles between two loops, forward along `a` and backward along `b`: the
    shortest ones of which none lies in a cube face; none at all if there are none.
    """
    m, n = len(a), len(b)
    cost = _cost_within(a, b)
    best = _FORBIDDEN, ()
    for start, turns in itertools.product(
        range(n), itertools.combinations(range(m + n), m)
    ):
        i, j, crossed, cut = 0, start, [], []
        for step in range(m + n):
            crossed.append((a[i % m], b[j % n]))
            if step in turns:
                cut.append((a[i % m], a[(i + 1) % m], b[j % n]))
                i += 1
            else:
                cut.append((b[(j - 1) % n], b[j % n], a[i % m]))
                j -= 1
        total = sum(cost(*e) for e in crossed)
        valid = total < best[0] and len(set(crossed)) == m + n
        if valid and not any(_faces_of(*t) for t in cut):
            best = total, tuple(cut)
    return best[1]


def _faces_of(*edges: Edge):
    """The cube faces that hold all these edges, by number."""
    corners = {c for e in edges for c in e}
    return [f for f, ring in enumerate(faces()) if corners <= set(ring)]


def _cost_within(*loops):
    """The cost of a diagonal in a cell with these loops: the squared length between the
    edge middles; more within a cube face; prohibitive if it belongs to the neighbor."""
    sides = {frozenset(s) for x in loops for s in zip(x, x[1:] + x[:1], strict=True)}
    middle = lambda e, d: (e[0] >> d & 1) + (e[1] >> d & 1)

    @functools.cache
    def cost(a, b):
        for face in _faces_of(a, b):
            return _IN_FACE if owned(face, a, b, sides) else _FORBIDDEN
        return sum((middle(a, d) - middle(b, d)) ** 2 for d in range(3))

    return cost


def owned(face: int, a: Edge, b: Edge, sides) -> bool:
    """Whether a diagonal within a cube face, from edge a to edge b, is of this cell.

    `sides` are the pairs of edges that the surface joins. Four diagonals join the two
    segments of surface on a face. The lower cell owns the one along the first axis of
    the face where the segments cut off its lowest corner, the one along the second
    axis elsewhere; the upper cell owns the three others. A search over such rules found
    this one, by which all loops and tubes can be cut.
    """
    u, v = 1 << (face // 2 + 1) % 3, 1 << (face // 2 + 2) % 3
    lowest = min(faces()[face])
    corner = frozenset((edge(lowest, lowest + u), edge(lowest, lowest + v)))
    # Opposite edges of a face run along one axis, and the diagonal along the other.
    across = v if corner in sides else u
    along = a[1] - a[0] == across and b[1] - b[0] == across
    return along == bool(face % 2)


@functools.cache
def edge_codes() -> dict[Edge, int]:
    """Each edge in 5 bits: its axis (2), and the offset x, y, z of its lower node."""
    axis = {1: 0, 2: 1, 4: 2}
    return {(low, high): axis[high - low] | low << 2 for low, high in edges()}


class CaseTables(NamedTuple):
    """Triangles of all ways in which the surface may pass a cell.

    - `row`: [256 * 64] the row of a case and of the faces that are joined, as bits;
      None where the row is the case.
    - `tunnel`: [3 * rows] the rows with the inside or the outside joined through the
      cell as well: entry 3 * row + 0 for neither, 1 for the inside, 2 for the outside.
    - `counts`: [rows] the number of triangles.
    - `triangles`: [rows * width], three edge codes of 5 bits each, lowest first, turned
      so that they are counter-clockwise seen from outside: the loops run the other way.
    """

    row: np.ndarray | None
    tunnel: np.ndarray | None
    counts: np.ndarray
    triangles: np.ndarray
    width: int


@functools.cache
def case_tables() -> CaseTables:
    """The tables for inside corners that stay apart on ambiguous faces: 256 rows."""
    return _packed([_discs(loops(case)) for case in range(256)])


@functools.cache
def decided_tables() -> CaseTables:
    """The tables for every choice on ambiguous faces: 656 rows."""
    row, ways = _decided()
    return _packed([_discs(way) for _, way in ways], row)


@functools.cache
def trilinear_tables() -> CaseTables:
    """The tables for every choice on ambiguous faces and inside of cells: the rows of
    `decided_tables`, then those with a tunnel."""
    row, ways = _decided()
    cells = [_discs(way) for _, way in ways]
    tunnel = np.repeat(np.arange(len(ways), dtype=np.int32)[:, None], 3, axis=1)
    for i, (case, way) in enumerate(ways):
        for side, triangles in _with_tunnel(case, way):
            tunnel[i, side] = len(cells)
            cells.append(triangles)
    return _packed(cells, row, tunnel.reshape(-1))


def tables_for(joined, tunnels) -> CaseTables:
    """The tables for what a rule decides: None for nothing."""
    if tunnels is not None:
        return trilinear_tables()
    return case_tables() if joined is None else decided_tables()


def _with_tunnel(case, way):
    """The sides that a tunnel may join, 1 for the inside, and the triangles then.

    Of three loops, two around opposite corners and one between them, the tunnel joins
    a corner with its like across the middle one.
    """
    if len(way) == 2:
        cells = tube(*way)
        return [(1, cells), (2, cells)] if cells else []
    if sorted(map(len, way)) != [3, 3, 6]:
        return []
    first, second, middle = sorted(way, key=len)
    out = []
    for loop, rest in ((first, second), (second, first)):
        if not (cells := tube(loop, middle)):
            continue
        (corner,) = set.intersection(*(set(e) for e in loop))
        side = 1 if case >> corner & 1 else 2
        out.append((side, cells + triangulate(rest)))
    return out


def _decided():
    """The row of every case and choice of faces; the case and the loops of the rows."""
    row = np.zeros((256, 64), np.int32)
    ways = []
    for case in range(256):
        relevant = sum(1 << f for f in ambiguous_faces(case))
        first = {}
        for joined in range(64):
            if joined & relevant not in first:
                first[joined & relevant] = len(ways)
                ways.append((case, loops(case, joined)))
            row[case, joined] = first[joined & relevant]
    return row.reshape(-1), ways


def _discs(way):
    return tuple(t for loop in way for t in triangulate(loop))


def _packed(cells, row=None, tunnel=None) -> CaseTables:
    codes = edge_codes()
    counts = np.array([len(triangles) for triangles in cells], np.int32)
    packed = np.zeros((len(cells), counts.max()), np.int32)
    for i, triangles in enumerate(cells):
        for j, (a, b, c) in enumerate(triangles):
            low, middle, high = codes[c], codes[b], codes[a]
            packed[i, j] = low | middle << CODE_BITS | high << 2 * CODE_BITS
    return CaseTables(row, tunnel, counts, packed.reshape(-1), int(counts.max()))
