"""Limit positions and normals against many levels of refinement."""

import jax
import numpy as np
import pytest

from jaxgeom import GeometryError, PolygonMesh, TriangleMesh
from jaxgeom.subdivision import (
    CatmullClark,
    Creases,
    LaneRiesenfeld,
    Loop,
    Midpoint,
    Warren,
    curve_limit,
    limit,
)

from .meshes_for_tests import (
    bowl,
    cube,
    faces_of,
    follow,
    house,
    hull,
    refined,
    ring,
    sheet,
    valence,
)

SCHEMES = {"loop": Loop(), "warren": Loop(Warren()), "catmull-clark": CatmullClark()}
EACH = pytest.mark.parametrize("scheme", SCHEMES.values(), ids=SCHEMES.keys())


def limit_at(mesh, vertex, scheme, creases=None):
    """The limit of one vertex and the normals of its sectors, in numpy."""
    planned = limit(mesh, scheme=scheme, creases=creases)
    v = np.asarray(mesh.vertices)
    apply = lambda s: s.to_scipy() @ v
    normals = np.cross(apply(planned.first), apply(planned.second))
    normals = normals[np.asarray(planned.vertices) == vertex]
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return apply(planned.position)[vertex], normals / length


def crease_at(n, other, sharpness=np.inf):
    """A vertex of n edges of the hull, with a crease through two (or one) of them."""
    vertex = int(np.flatnonzero(valence(hull()) == n)[0])
    around = ring(hull(), vertex)
    ends = [around[0]] if other is None else [around[0], around[other]]
    return vertex, Creases([(vertex, end) for end in ends], sharpness)


@EACH
@pytest.mark.parametrize("n", [3, 4, 5, 6, 8])
def test_smooth_vertices(x64, scheme, n):
    vertex = int(np.flatnonzero(valence(hull()) == n)[0])
    place, normals = limit_at(hull(), vertex, scheme)
    far, around = follow(hull(), vertex, 40, scheme)
    np.testing.assert_allclose(place, far, atol=1e-12)
    # The eigenvalue after the tangents' decides how fast the normals settle.
    atol = {3: 1e-12, 4: 1e-6, 5: 1e-7, 6: 1e-5, 8: 1e-3}[n]
    np.testing.assert_allclose(
        around, np.broadcast_to(normals, around.shape), atol=atol
    )


@EACH
@pytest.mark.parametrize("n", [3, 4, 5, 6, 8])
def test_creases_and_their_ends(x64, scheme, n):
    for other in (None, n // 2):
        vertex, creases = crease_at(n, other)
        place, normals = limit_at(hull(), vertex, scheme, creases)
        assert len(normals) == (1 if other is None else 2)
        far, around = follow(hull(), vertex, 40, scheme, creases)
        np.testing.assert_allclose(place, far, atol=1e-10)
        if n < 8:
            off = np.linalg.norm(around[:, None] - normals, axis=-1).min(axis=1)
            assert off.max() < 1e-3


@EACH
def test_ten_levels_reach_a_millionth(x64, scheme):
    """Where the third eigenvalue is 1/4 or less: 4^-10 of the second differences."""
    quads = isinstance(scheme, CatmullClark)
    mesh = cube() if quads else hull()
    vertices = [0] if quads else [np.flatnonzero(valence(mesh) == n)[0] for n in (3, 6)]
    for vertex in map(int, vertices):
        place, _ = limit_at(mesh, vertex, scheme)
        far, _ = follow(mesh, vertex, 10, scheme)
        np.testing.assert_allclose(place, far, atol=1e-6)
    for n in (4, 6, 8):
        vertex, creases = crease_at(n, n // 2)
        place, _ = limit_at(hull(), vertex, scheme, creases)
        far, _ = follow(hull(), vertex, 10, scheme, creases)
        np.testing.assert_allclose(place, far, atol=1e-6)


@pytest.mark.parametrize("n", [4, 6])
@EACH
def test_semi_sharp_creases(x64, scheme, n):
    vertex, creases = crease_at(n, n // 2, [1.4, 0.7])
    place, normals = limit_at(hull(), vertex, scheme, creases)
    assert len(normals) == 1
    far, around = follow(hull(), vertex, 40, scheme, creases)
    np.testing.assert_allclose(place, far, atol=1e-12)
    np.testing.assert_allclose(
        around, np.broadcast_to(normals, around.shape), atol=1e-5
    )


CASES = {
    "loop": (hull, Loop()),
    "loop, border": (bowl, Loop(Warren())),
    "catmull-clark": (cube, CatmullClark()),
    "catmull-clark, border": (sheet, CatmullClark()),
    "catmull-clark, mixed": (house, CatmullClark()),
}


@pytest.mark.parametrize("sharp", [False, True], ids=["smooth", "creases"])
@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_the_limit_does_not_change_with_the_level(x64, case, sharp):
    """Limits of the fine mesh are those of the coarse one, at all its vertices."""
    mesh, scheme = case[0](), case[1]
    sides = faces_of(mesh)[0]
    edges = np.concatenate([sides[:2, :2], sides[1:3, 1:3]])
    # A fixed vertex with a single sharp edge has no tangent plane: take another.
    pin = np.setdiff1d(np.arange(8), edges)[:1]
    creases = Creases(edges, np.inf, pin) if sharp else None
    vertices, faces, left, flat = refined(mesh, 1, scheme, creases)
    fine = TriangleMesh(vertices, faces[0]) if flat else PolygonMesh(vertices, faces)
    for vertex in range(mesh.vertices.shape[0]):
        place, normals = limit_at(mesh, vertex, scheme, creases)
        later, turned = limit_at(fine, vertex, scheme, left)
        np.testing.assert_allclose(place, later, atol=1e-13)
        np.testing.assert_allclose(normals, turned, atol=1e-11)
        if vertex >= 8:
            break


@pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())
def test_limits_are_affine(x64, case):
    planned = limit(case[0](), scheme=case[1])
    sums = lambda s: s.to_scipy().sum(axis=1)
    np.testing.assert_allclose(sums(planned.position), 1, atol=1e-13)
    np.testing.assert_allclose(sums(planned.first), 0, atol=1e-12)
    np.testing.assert_allclose(sums(planned.second), 0, atol=1e-12)


def test_the_border_has_the_limit_of_a_cubic_spline(x64):
    mesh = sheet()
    rim = np.array([0, 3, 6, 9, 10, 11, 8, 5, 2, 1])
    places = limit(mesh, scheme=CatmullClark()).position.to_scipy() @ mesh.vertices
    curve = curve_limit(len(rim), scheme=LaneRiesenfeld(3)) @ mesh.vertices[rim]
    np.testing.assert_allclose(places[rim], curve, atol=1e-14)


def test_a_regular_sheet_is_a_bicubic_spline(x64):
    """Where all is regular the limit is that of the tensor product of two curves."""
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0), indexing="ij")
    height = np.random.default_rng(0).normal(size=x.shape)
    i, j = (k.ravel() for k in np.meshgrid(range(4), range(3), indexing="ij"))
    first = 4 * i + j
    faces = np.stack([first, first + 4, first + 5, first + 1], -1)
    mesh = PolygonMesh(np.stack([x, y, height], -1).reshape(-1, 3), faces)
    places = limit(mesh, scheme=CatmullClark()).position.to_scipy() @ mesh.vertices
    mask = np.array([1, 4, 1]) / 6
    want = mask @ height[1:4, 1:4] @ mask
    np.testing.assert_allclose(places[4 * 2 + 2], [2, 2, want], atol=1e-14)
    planned = limit(mesh, scheme=CatmullClark())
    normal = np.asarray(planned.normals(mesh.vertices))[4 * 2 + 2]
    slope = np.array([-1, 0, 1]) / 2
    dx, dy = slope @ height[1:4, 1:4] @ mask, mask @ height[1:4, 1:4] @ slope
    want = np.array([-dx, -dy, 1]) / np.sqrt(1 + dx**2 + dy**2)
    np.testing.assert_allclose(normal, want, atol=1e-13)


def test_normals_of_a_sphere_like_mesh_point_outside(x64):
    planned = limit(hull())
    v = hull().vertices
    normals = jax.jit(lambda p, v: p.normals(v))(planned, v)
    assert np.all(np.sum(normals * (planned.position @ v), axis=1) > 0)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-14)


def test_sectors_of_corners(x64):
    """The rim of a cube: two sectors at its vertices, one at the others."""
    creases = Creases([(1, 3), (3, 7), (7, 5), (5, 1)])
    planned = limit(cube(), scheme=CatmullClark(), creases=creases)
    assert np.bincount(planned.vertices).tolist() == [1, 2, 1, 2, 1, 2, 1, 2]
    (corners,) = planned.corners
    faces = np.asarray(cube().faces[0])
    np.testing.assert_array_equal(np.asarray(planned.vertices)[corners], faces)
    normals = planned.sector_normals(cube().vertices)
    top = np.all(np.asarray(cube().vertices)[faces][:, :, 2] == 1, axis=1)
    # Above the rim is a disc whose normals are up at its border.
    np.testing.assert_allclose(normals[corners[top][0]][:, 2], 1, atol=1e-14)
    side = normals[corners[~top]].reshape(-1, 3)
    assert np.all(side[:, 2] < 0.5)


def test_derivatives_reach_the_vertices(x64):
    planned, v = limit(hull()), np.asarray(hull().vertices)
    energy = lambda v: (
        planned.normals(v)[:, 2] * planned.position.__matmul__(v)[:, 0]
    ).sum()
    h, direction = 1e-6, np.cos(5 * v)
    slope = jax.jit(lambda v: jax.jvp(energy, (v,), (direction,))[1])(v)
    ends = jax.jit(jax.vmap(energy))(np.stack([v + h * direction, v - h * direction]))
    np.testing.assert_allclose((ends[0] - ends[1]) / (2 * h), slope, rtol=1e-7)


def test_limits_that_do_not_exist_are_errors():
    with pytest.raises(GeometryError, match="known for Loop and CatmullClark"):
        limit(hull(), scheme=Midpoint())
    with pytest.raises(GeometryError, match="less than 2.31 corners after 13 levels"):
        limit(hull(), creases=crease_at(6, 3, 12.5)[1])
    twisted = np.array(hull().faces)
    twisted[0] = twisted[0][::-1]
    with pytest.raises(GeometryError, match="opposite directions"):
        limit(TriangleMesh(hull().vertices, twisted))
    tetrahedron = np.array([(0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)])
    other = np.where(tetrahedron > 0, tetrahedron + 3, 0)
    touching = TriangleMesh(np.zeros((7, 3)), np.concatenate([tetrahedron, other]))
    with pytest.raises(GeometryError, match="must be one fan"):
        limit(touching)
    assert limit(touching, creases=Creases(vertices=[0])).position.shape == (7, 7)
