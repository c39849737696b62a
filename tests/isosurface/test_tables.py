"""Facts of the case table that follow from the topology of the cube."""

import itertools

import numpy as np
import pytest

from jaxgeom.isosurface._cube import edges, faces, loops
from jaxgeom.isosurface._tables import case_tables, triangulate

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
