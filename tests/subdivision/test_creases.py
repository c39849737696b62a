"""Sharp and semi-sharp edges and vertices."""

import numpy as np
import pytest

from jaxgeom import GeometryError
from jaxgeom.subdivision import (
    CatmullClark,
    ChaikinDecay,
    Closed,
    Creases,
    KeptEnds,
    LaneRiesenfeld,
    Loop,
    plan_subdivision,
    subdivide_curve,
)

from .meshes_for_tests import (
    cube,
    edges_of,
    faces_of,
    gap,
    house,
    hull,
    refined,
    ring,
    sheet,
    valence,
)
from .plain_catmull_clark import level

TOP = np.array([(1, 3), (3, 7), (7, 5), (5, 1)])
SCHEMES = pytest.mark.parametrize(
    "scheme", [Loop(), CatmullClark()], ids=["loop", "cc"]
)


def middle():
    """A vertex of six edges of the hull and its ring."""
    vertex = int(np.flatnonzero(valence(hull()) == 6)[0])
    return vertex, ring(hull(), vertex)


@SCHEMES
def test_an_infinite_crease_is_a_cubic_spline(x64, scheme):
    _, loop = middle()
    closed = Creases(np.stack([loop, np.roll(loop, -1)], -1))
    points = np.asarray(hull().vertices)[loop]
    vertices, _, left, _ = refined(hull(), 3, scheme, closed)
    curve = subdivide_curve(points, 3, scheme=LaneRiesenfeld(3), ends=Closed())
    assert gap(vertices[np.unique(left.edges)], curve) < 1e-14
    assert np.all(np.isinf(left.sharpness)) and len(left.edges) == 8 * len(loop)


@SCHEMES
def test_a_crease_between_corners_is_an_open_spline(x64, scheme):
    vertex, loop = middle()
    line = [loop[0], vertex, loop[3]]
    creases = Creases([line[:2], line[1:]], np.inf, [line[0], line[2]])
    vertices, _, left, _ = refined(hull(), 3, scheme, creases)
    points = np.asarray(hull().vertices)[line]
    curve = subdivide_curve(points, 3, scheme=LaneRiesenfeld(3), ends=KeptEnds())
    assert gap(vertices[np.unique(left.edges)], curve) < 1e-14


@SCHEMES
def test_sharpness_blends_and_decays(x64, scheme):
    _, loop = middle()
    edges = np.stack([loop, np.roll(loop, -1)], -1)
    at = lambda s, levels: refined(hull(), levels, scheme, Creases(edges, s))[0]
    smooth, sharp = at(0, 1), at(np.inf, 1)
    assert gap(smooth, sharp) > 1e-2
    np.testing.assert_allclose(at(0.3, 1), 0.7 * smooth + 0.3 * sharp, atol=1e-14)
    for s in (1, 1.3, 7):
        np.testing.assert_allclose(at(s, 1), sharp, atol=1e-15)
    # One level sharp, then 0.3 of a level.
    np.testing.assert_allclose(at(1.3, 2), 0.7 * at(1, 2) + 0.3 * at(2, 2), atol=1e-14)
    np.testing.assert_allclose(at(1.3, 3), 0.7 * at(1, 3) + 0.3 * at(2, 3), atol=1e-14)


def test_a_cube_with_a_sharp_rim_by_hand(x64):
    vertices, _, _, _ = refined(cube(), 1, CatmullClark(), Creases(TOP, np.inf))
    corners = np.asarray(cube().vertices)
    rim = [1, 3, 7, 5]
    expected = (
        corners[rim] * 6 + np.roll(corners[rim], 1, 0) + np.roll(corners[rim], -1, 0)
    )
    np.testing.assert_allclose(vertices[rim], expected / 8, atol=1e-15)
    below = [0, 2, 4, 6]
    np.testing.assert_allclose(
        vertices[below], (2 + 5 * corners[below]) / 9, atol=1e-15
    )


def test_unequal_sharpness_fades_between_rules(x64):
    """At a corner of the cube with edges of 1.3 and 0.5: a crease that ends now."""
    vertices, _, _, _ = refined(
        cube(), 1, CatmullClark(), Creases([(0, 1), (0, 2)], [1.3, 0.5])
    )
    crease, smooth = np.array([0, 1 / 8, 1 / 8]), np.full(3, 2 / 9)
    # Of the two only the edge of 0.5 ceases to be sharp: that is the share.
    np.testing.assert_allclose(vertices[0], 0.5 * crease + 0.5 * smooth, atol=1e-15)


def test_three_sharp_edges_or_a_sharp_vertex_are_a_corner(x64):
    star = [(0, 1), (0, 2), (0, 4)]
    for creases in (Creases(star, 2.0), Creases(vertices=[0], vertex_sharpness=2.0)):
        vertices, _, left, _ = refined(cube(), 1, CatmullClark(), creases)
        np.testing.assert_allclose(vertices[0], 0, atol=1e-15)
        assert left.vertex_sharpness.tolist() in ([], [1.0])
    half, _, _, _ = refined(cube(), 1, CatmullClark(), Creases((), 0, [0], 0.5))
    np.testing.assert_allclose(half[0], 1 / 9, atol=1e-15)


def test_one_sharp_edge_ends_smoothly(x64):
    sharp, _, _, _ = refined(cube(), 1, CatmullClark(), Creases([(0, 1)]))
    smooth, _, _, _ = refined(cube(), 1, CatmullClark())
    np.testing.assert_allclose(sharp[0], smooth[0], atol=1e-15)
    moved = np.flatnonzero(np.linalg.norm(sharp - smooth, axis=1) > 1e-9)
    np.testing.assert_allclose(sharp[moved], [[0, 0, 0.5]], atol=1e-15)


def test_chaikin_mixes_sharpness_along_a_crease():
    scheme = CatmullClark(ChaikinDecay())
    creases = Creases(TOP, [2.0, 3.0, 4.0, np.inf])
    left = plan_subdivision(cube(), 1, scheme=scheme, creases=creases).creases
    found = {}
    for (vertex, _), s in zip(
        np.sort(left.edges, 1).tolist(), left.sharpness, strict=True
    ):
        found.setdefault(vertex, []).append(s)
    # The half at a vertex gets (3 s + t) / 4 - 1; infinite sharpness is not mixed in.
    assert sorted(found[3]) == [(3 * 2 + 3) / 4 - 1, (3 * 3 + 2) / 4 - 1]
    assert sorted(found[7]) == [(3 * 3 + 4) / 4 - 1, (3 * 4 + 3) / 4 - 1]
    assert sorted(found[1]) == [2 - 1, np.inf]
    assert sorted(found[5]) == [4 - 1, np.inf]


def test_the_order_of_ends_and_repeats_do_not_matter(x64):
    a, _, _, _ = refined(cube(), 2, CatmullClark(), Creases(TOP, 1.5))
    twice = np.concatenate([TOP[:, ::-1], TOP])
    b, _, _, _ = refined(
        cube(), 2, CatmullClark(), Creases(twice, [0.5] * 4 + [1.5] * 4)
    )
    np.testing.assert_array_equal(a, b)


BAD = {
    "edge that is none": (lambda: Creases([(0, 3)]), r"first \(0, 3\)"),
    "edge of no vertex": (lambda: Creases([(0, 99)]), "must be vertices 0 ... 7"),
    "vertex that is none": (lambda: Creases(vertices=[8]), "must be vertices 0 ... 7"),
    "negative": (lambda: Creases([(0, 1)], -1.0), "sharpness must be at least 0"),
    "undefined": (lambda: Creases([(0, 1)], np.nan), "sharpness must be at least 0"),
    "sizes": (lambda: Creases([(0, 1)], [1.0, 2.0]), "sharpness must have shape"),
    "triples": (lambda: Creases([(0, 1, 2)]), "edges must have shape"),
}


@pytest.mark.parametrize("case", BAD.values(), ids=BAD.keys())
def test_bad_creases_are_errors(case):
    with pytest.raises(GeometryError, match=case[1]):
        plan_subdivision(cube(), 1, scheme=CatmullClark(), creases=case[0]())


def test_edges_of_the_cube_are_all_there():
    edges = edges_of(cube())
    assert len(edges) == 12
    left = plan_subdivision(
        cube(), 1, scheme=CatmullClark(), creases=Creases(edges, 3.0)
    ).creases
    assert len(left.edges) == 24 and np.all(left.sharpness == 2.0)


@pytest.mark.parametrize("mesh", [house, sheet], ids=["closed", "border"])
def test_all_sharpness_against_a_plain_program(x64, mesh):
    generator = np.random.default_rng(4)
    edges = edges_of(mesh())
    for _ in range(4):
        some = generator.random(len(edges)) < 0.6
        s = generator.choice([0.2, 0.7, 1.0, 1.6, 2.3, np.inf], some.sum())
        pins, t = generator.choice(9, 3, replace=False), np.array([0.4, 1.3, np.inf])
        vertices, _, _, _ = refined(
            mesh(), 3, CatmullClark(), Creases(edges[some], s, pins, t)
        )
        points = dict(enumerate(np.asarray(mesh().vertices)))
        faces = [tuple(face) for group in faces_of(mesh()) for face in group.tolist()]
        sharp = dict(zip(map(frozenset, edges[some].tolist()), s, strict=True))
        state = points, faces, sharp, dict(zip(pins.tolist(), t, strict=True))
        for _ in range(3):
            state = level(*state)
        assert gap(vertices, np.array(list(state[0].values()))) < 1e-14
