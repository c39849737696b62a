"""The case table of marching cubes, derived from the loops of the cube.

Loops are cut into triangles without a diagonal between two edges of one cube face: the
neighbor cell might use the same diagonal, and an edge would have four faces.
"""

import functools
from typing import NamedTuple

import numpy as np

from ._cube import Edge, ambiguous_faces, edges, faces, loops

CODE_BITS = 5
_FORBIDDEN = 10**6


@functools.cache
def diagonal_cost(a: Edge, b: Edge) -> int:
    """The squared length between two edge middles; prohibitive within a cube face."""
    if any({*a, *b} <= set(ring) for ring in faces()):
        return _FORBIDDEN
    middle = lambda e, d: (e[0] >> d & 1) + (e[1] >> d & 1)
    return sum((middle(a, d) - middle(b, d)) ** 2 for d in range(3))


def triangulate(loop: tuple[Edge, ...]) -> tuple[tuple[Edge, Edge, Edge], ...]:
    """The triangles of a loop: no diagonal in a cube face, and the shortest ones.

    The polygon from corner i to corner j is best cut by the triangle (i, k, j) that
    makes the sum over both rests smallest.
    """
    n = len(loop)

    @functools.cache
    def best(i, j):
        if j - i < 2:
            return 0, ()
        own = 0 if (i, j) == (0, n - 1) else diagonal_cost(loop[i], loop[j])
        options = []
        for k in range(i + 1, j):
            (left, cut_left), (right, cut_right) = best(i, k), best(k, j)
            options.append((left + right, (*cut_left, (i, k, j), *cut_right)))
        cost, cut = min(options)
        return own + cost, cut

    return tuple((loop[i], loop[j], loop[k]) for i, j, k in best(0, n - 1)[1])


@functools.cache
def edge_codes() -> dict[Edge, int]:
    """Each edge in 5 bits: its axis (2), and the offset x, y, z of its lower node."""
    axis = {1: 0, 2: 1, 4: 2}
    return {(low, high): axis[high - low] | low << 2 for low, high in edges()}


class CaseTables(NamedTuple):
    """Triangles of all ways in which the surface may pass a cell.

    - `row`: [256 * 64] the row of a case and of the faces that are joined, as bits;
      None where the row is the case.
    - `counts`: [rows] the number of triangles.
    - `triangles`: [rows * width], three edge codes of 5 bits each, lowest first, turned
      so that they are counter-clockwise seen from outside: the loops run the other way.
    """

    row: np.ndarray | None
    counts: np.ndarray
    triangles: np.ndarray
    width: int


@functools.cache
def case_tables() -> CaseTables:
    """The tables for inside corners that stay apart on ambiguous faces: 256 rows."""
    return _packed(None, [loops(case) for case in range(256)])


@functools.cache
def decided_tables() -> CaseTables:
    """The tables for every choice on ambiguous faces: 656 rows."""
    row = np.zeros((256, 64), np.int32)
    ways = []
    for case in range(256):
        relevant = sum(1 << f for f in ambiguous_faces(case))
        first = {}
        for joined in range(64):
            if joined & relevant not in first:
                first[joined & relevant] = len(ways)
                ways.append(loops(case, joined))
            row[case, joined] = first[joined & relevant]
    return _packed(row.reshape(-1), ways)


def _packed(row, ways) -> CaseTables:
    codes = edge_codes()
    cells = [[t for loop in way for t in triangulate(loop)] for way in ways]
    counts = np.array([len(triangles) for triangles in cells], np.int32)
    packed = np.zeros((len(ways), counts.max()), np.int32)
    for i, triangles in enumerate(cells):
        for j, (a, b, c) in enumerate(triangles):
            low, middle, high = codes[c], codes[b], codes[a]
            packed[i, j] = low | middle << CODE_BITS | high << 2 * CODE_BITS
    return CaseTables(row, counts, packed.reshape(-1), int(counts.max()))
