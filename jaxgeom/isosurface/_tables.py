"""The case table of marching cubes, derived from the loops of the cube.

Loops are cut into triangles without a diagonal between two edges of one cube face: the
neighbor cell might use the same diagonal, and an edge would have four faces.
"""

import functools

import numpy as np

from ._cube import Edge, edges, faces, loops

MAX_TRIANGLES = 5
CODE_BITS = 5
_FORBIDDEN = 10**6


@functools.cache
def triangulations(first: int, last: int) -> tuple:
    """All ways to cut the polygon of corners first..last into triangles."""
    if last - first < 2:
        return ((),)
    return tuple(
        (*left, (first, k, last), *right)
        for k in range(first + 1, last)
        for left in triangulations(first, k)
        for right in triangulations(k, last)
    )


@functools.cache
def diagonals(cut: tuple, n: int) -> tuple:
    """The pairs of corners of an n-gon that the triangles of a cut join inside it."""
    sides = {side for a, b, c in cut for side in ((a, b), (b, c), (a, c))}
    return tuple(sorted((a, b) for a, b in sides if b - a not in (1, n - 1)))


@functools.cache
def diagonal_cost(a: Edge, b: Edge) -> int:
    """The squared length between two edge middles; prohibitive within a cube face."""
    if any({*a, *b} <= set(ring) for ring in faces()):
        return _FORBIDDEN
    middle = lambda e, d: (e[0] >> d & 1) + (e[1] >> d & 1)
    return sum((middle(a, d) - middle(b, d)) ** 2 for d in range(3))


def triangulate(loop: tuple[Edge, ...]) -> tuple[tuple[Edge, Edge, Edge], ...]:
    """The triangles of a loop: no diagonal in a cube face, and the shortest ones."""
    n = len(loop)

    def cost(cut):
        return sum(diagonal_cost(loop[i], loop[j]) for i, j in diagonals(cut, n)), cut

    best = min(triangulations(0, n - 1), key=cost)
    return tuple((loop[i], loop[j], loop[k]) for i, j, k in best)


@functools.cache
def edge_codes() -> dict[Edge, int]:
    """Each edge in 5 bits: its axis (2), and the offset x, y, z of its lower node."""
    axis = {1: 0, 2: 1, 4: 2}
    return {(low, high): axis[high - low] | low << 2 for low, high in edges()}


@functools.cache
def case_tables() -> tuple[np.ndarray, np.ndarray]:
    """(number of triangles [256], packed triangles [256 * 5]) of all cases.

    A packed triangle holds three edge codes of 5 bits, lowest first, turned so that it
    is counter-clockwise seen from outside: the loops run the other way.
    """
    codes = edge_codes()
    counts = np.zeros(256, np.int32)
    packed = np.zeros((256, MAX_TRIANGLES), np.int32)
    for case in range(256):
        triangles = [t for loop in loops(case) for t in triangulate(loop)]
        counts[case] = len(triangles)
        for j, (a, b, c) in enumerate(triangles):
            low, middle, high = codes[c], codes[b], codes[a]
            packed[case, j] = low | middle << CODE_BITS | high << 2 * CODE_BITS
    return counts, packed.reshape(-1)
