"""Facts of the case table that follow from the topology of the cube."""

import itertools

import numpy as np
import pytest

from jaxgeom.isosurface._cube import edges, faces, loops
from jaxgeom.isosurface._tables import (
    CODE_BITS,
    case_tables,
    edge_codes,
    owned,
    triangulate,
    trilinear_tables,
)

CASES = range(256)


def test_numbers_of_loops_and_triangles():
    per_case = [len(loops(case)) for case in CASES]
    lengths = [len(loop) for case in CASES for loop in loops(case)]
    assert max(per_case) == 4 and sum(per_case) == 358
    assert np.bincount(lengths)[3:].tolist() == [144, 66, 72, 52, 24]
    assert np.bincount(case_tables().counts).tolist() == [2, 16, 50, 80, 76, 32]


def test_number_of_ambiguous_faces():
    def ambiguous(case, ring):
        a, b, c, d = (case >> corner & 1 for corner in ring)
        return a == c and b == d and a != b

    per_case = [sum(ambiguous(case, ring) for ring in faces()) for case in CASES]
    assert np.bincount(per_case).tolist() == [136, 72, 30, 16, 0, 0, 2]


@pytest.mark.parametrize("block", range(8))
def test_loops_pass_each_cut_edge_once(block):
    for case in range(32 * block, 32 * block + 32):
        cut = [e for e in edges() if (case >> e[0] & 1) != (case >> e[1] & 1)]
        assert sorted(e for loop in loops(case) for e in loop) == cut


def test_no_diagonal_lies_in_a_cube_face():
    for loop in (loop for case in CASES for loop in loops(case)):
        sides = {frozenset((loop[i - 1], loop[i])) for i in range(len(loop))}
        for triangle in triangulate(loop):
            for a, b in itertools.combinations(triangle, 2):
                if frozenset((a, b)) not in sides:
                    assert not any({*a, *b} <= set(ring) for ring in faces())


def cells_of(tables):
    """The triangles of every row, as edges of the cube."""
    edge_of = {code: e for e, code in edge_codes().items()}
    packed = tables.triangles.reshape(-1, tables.width)
    shifts = [CODE_BITS * k for k in range(3)]
    for row, count in zip(packed, tables.counts, strict=True):
        yield [[edge_of[t >> s & 31] for s in shifts] for t in row[:count].tolist()]


def test_every_choice_is_a_surface_whose_face_diagonals_belong_to_one_cell():
    num_tubes = 0
    for triangles in cells_of(trilinear_tables()):
        directed = [(t[k - 1], t[k]) for t in triangles for k in range(3)]
        assert len(set(directed)) == len(directed)
        border = {frozenset(e) for e in directed if e[::-1] not in directed}
        corners = {e for t in triangles for e in t}
        inner = {frozenset(e) for e in directed} - border
        num_tubes += len(corners) - len(border) - len(inner) + len(triangles) == 0
        for a, b in inner:
            for face in (f for f, r in enumerate(faces()) if {*a, *b} <= set(r)):
                assert owned(face, a, b, border)
        for triangle in triangles:
            held = {c for e in triangle for c in e}
            assert not any(held <= set(ring) for ring in faces())
    assert num_tubes > 148


def test_the_two_cells_beside_a_face_share_no_diagonal():
    lower, upper = ([f for f in range(6) if f % 2 == side] for side in (1, 0))
    for below, above in zip(lower, upper, strict=True):
        axis = 1 << below // 2
        cross = [e for e in edges() if set(e) <= set(faces()[above])]
        lift = lambda e, axis=axis: (e[0] + axis, e[1] + axis)
        for ends in itertools.permutations(cross):
            sides = [frozenset(ends[:2]), frozenset(ends[2:])]
            if any(not set(a) & set(b) for a, b in sides):
                continue
            moved = [frozenset(map(lift, s)) for s in sides]
            for a, b in itertools.product(ends[:2], ends[2:]):
                here = owned(above, *sorted((a, b)), sides)
                assert here != owned(below, *map(lift, sorted((a, b))), moved)
