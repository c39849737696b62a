"""The topology of the unit cube: corners, edges, faces, and the loops of a surface.

Corner c lies at (c & 1, c >> 1 & 1, c >> 2). On each face, walked counter-clockwise
seen from outside, an edge from an inside to an outside corner is an *exit*, the
opposite an *enter*. Every exit is joined to the enter before it in the walk, which
began the same run of inside corners: two inside corners across a face diagonal stay
apart. A cut edge is an exit in one of its two faces and an enter in the other, so the
joins close to oriented loops. The neighbor cell sees the same face reversed and makes
the same joins reversed: the surface is closed and oriented by construction.
"""

import functools
import itertools

Edge = tuple[int, int]


@functools.cache
def faces() -> tuple[tuple[int, int, int, int], ...]:
    """The 4 corners of each of the 6 faces, counter-clockwise seen from outside."""
    out = []
    for axis, side in itertools.product(range(3), (0, 1)):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        ring = [0, u, u + v, v]
        base = side << axis
        out.append(tuple(base + c for c in (ring if side else reversed(ring))))
    return tuple(out)


def edge(a: int, b: int) -> Edge:
    """The edge between two corners, the lower corner first."""
    return (a, b) if a < b else (b, a)


@functools.cache
def edges() -> tuple[Edge, ...]:
    """The 12 edges."""
    sides = {edge(ring[i - 1], ring[i]) for ring in faces() for i in range(4)}
    return tuple(sorted(sides))


@functools.cache
def ambiguous_faces(case: int) -> tuple[int, ...]:
    """The faces whose inside corners are the two ends of a diagonal."""
    inside = [[case >> c & 1 for c in ring] for ring in faces()]
    return tuple(
        f for f, (a, b, c, d) in enumerate(inside) if a == c and b == d and a != b
    )


@functools.cache
def loops(case: int, joined: int = 0) -> tuple[tuple[Edge, ...], ...]:
    """The oriented loops of cut edges of the case whose bit c says: c is inside.

    On an ambiguous face f with bit f of `joined`, the inside corners are connected:
    every exit is joined to the enter after it.
    """
    follows = {}
    for f, ring in enumerate(faces()):
        inside = [bool(case >> c & 1) for c in ring]
        connected = f in ambiguous_faces(case) and joined >> f & 1
        for i in range(4):
            if inside[i] and not inside[(i + 1) % 4]:
                enter = _enter(ring, inside, (i + 2) % 4 if connected else i)
                follows[edge(ring[i], ring[(i + 1) % 4])] = enter
    out = []
    while follows:
        loop = [min(follows)]
        while (after := follows.pop(loop[-1])) != loop[0]:
            loop.append(after)
        out.append(tuple(loop))
    return tuple(out)


def _enter(ring, inside, i):
    """The edge by which the walk entered the run of inside corners that ends at i."""
    while inside[i - 1]:
        i -= 1
    return edge(ring[i - 1], ring[i])
