"""The table of surface patches: which cut edges of a cell belong together.

A patch is a loop of the cube (see `_cube.py`); the dual methods put one vertex on each.
A face whose four edges all lie on one loop is *bridged*: where it is bridged in both
cells that share it, both its segments would join the same two vertices, and the dual
edge would have four faces. Then the two inside corners of that face, and that face
alone, are connected instead: each cell has two loops in place of one, and the edge is
manifold again (36 of the 256 cases have a bridged face, and exactly one).
"""

import functools
from typing import NamedTuple

import numpy as np

from ._cube import Edge, ambiguous_faces, edges, faces, loops

NO_FACE = 6
FLIPPED = 256


class PatchTables(NamedTuple):
    """What the dual methods ask about a case; rows from 256 on have its face flipped.

    - `bridged`: [256] the bridged face, or `NO_FACE`.
    - `counts`: [512] the number of patches.
    - `patches`: [512] two bits per dual edge number: the patch that holds the edge.
    - `edges`: [512 * 4 * width] the edges of each patch, 5 bits as `edge_code` and one
      more that is set in real entries; zero in padding.
    """

    bridged: np.ndarray
    counts: np.ndarray
    patches: np.ndarray
    edges: np.ndarray
    width: int


def edge_code(edge: Edge) -> int:
    """An edge in 5 bits: its axis (2), and the offset x, y, z of its lower node."""
    low, high = edge
    return {1: 0, 2: 1, 4: 2}[high - low] | low << 2


def edge_number(edge: Edge) -> int:
    """4 axis + u + 2 v; u, v: the offsets along the two axes after that of the edge."""
    low, high = edge
    axis = {1: 0, 2: 1, 4: 2}[high - low]
    u, v = (axis + 1) % 3, (axis + 2) % 3
    return 4 * axis + (low >> u & 1) + 2 * (low >> v & 1)


REAL = 1 << 5


@functools.cache
def bridged_face(case: int) -> int:
    """The ambiguous face whose four edges lie on one loop of the case, or `NO_FACE`."""
    for f in ambiguous_faces(case):
        on_face = {e for e in edges() if set(e) <= set(faces()[f])}
        if any(on_face <= set(loop) for loop in loops(case)):
            return f
    return NO_FACE


@functools.cache
def patch_tables() -> PatchTables:
    """The tables of all cases, as they are and with the bridged face flipped."""
    bridged = [bridged_face(case) for case in range(256)]
    rows = [loops(case) for case in range(256)]
    rows += [loops(case, 1 << bridged[case]) for case in range(256)]
    return _packed(np.array(bridged, np.int32), rows)


def _packed(bridged, rows) -> PatchTables:
    width = max(len(loop) for row in rows for loop in row)
    patches = np.zeros(len(rows), np.int32)
    listed = np.zeros((len(rows), 4, width), np.int32)
    for i, row in enumerate(rows):
        for j, loop in enumerate(row):
            for k, edge in enumerate(loop):
                patches[i] |= j << 2 * edge_number(edge)
                listed[i, j, k] = edge_code(edge) | REAL
    counts = np.array([len(row) for row in rows], np.int32)
    return PatchTables(bridged, counts, patches, listed.reshape(-1), width)
