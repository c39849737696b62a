"""Schemes against trimesh and meshes worked by hand; laws of all schemes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxgeom import GeometryError, PolygonMesh, TriangleMesh
from jaxgeom.meshes import icosphere
from jaxgeom.subdivision import (
    Bilinear,
    CatmullClark,
    ChaikinDecay,
    Creases,
    Loop,
    Midpoint,
    Warren,
    plan_subdivision,
    subdivide,
)

from .meshes_for_tests import (
    bowl,
    cube,
    edges_of,
    faces_of,
    gap,
    house,
    hull,
    refined,
    sheet,
)

CASES = {
    "loop": (hull, Loop()),
    "loop, border": (bowl, Loop(Warren(), ChaikinDecay())),
    "catmull-clark": (house, CatmullClark()),
    "catmull-clark, border": (sheet, CatmullClark(ChaikinDecay())),
    "catmull-clark, triangles": (bowl, CatmullClark()),
    "midpoint": (hull, Midpoint()),
    "bilinear": (house, Bilinear()),
}
ALL = pytest.mark.parametrize("case", CASES.values(), ids=CASES.keys())


def some_creases(mesh):
    """Semi-sharp and infinite creases and a sharp vertex."""
    edges = edges_of(mesh)[::4]
    sharpness = np.resize([0.4, 1.7, np.inf, 2.5, 0.9], len(edges))
    return Creases(edges, sharpness, [1, 3], [np.inf, 0.7])


@pytest.mark.parametrize("mesh", [hull, bowl], ids=["closed", "border"])
def test_loop_agrees_with_trimesh(x64, mesh):
    vertices, faces, _, _ = refined(mesh(), 2, Loop())
    v, f = np.asarray(mesh().vertices), np.asarray(mesh().faces)
    other_vertices, other_faces = trimesh.remesh.subdivide_loop(v, f, 2)
    assert gap(vertices, other_vertices) < 1e-12
    centers = vertices[faces[0]].mean(axis=1), other_vertices[other_faces].mean(axis=1)
    assert gap(*centers) < 1e-12


def test_midpoints_agree_with_trimesh(x64):
    vertices, faces, _, _ = refined(hull(), 1, Midpoint())
    other = trimesh.remesh.subdivide(hull().vertices, hull().faces)
    assert gap(vertices, other[0]) < 1e-15
    assert gap(vertices[faces[0]].mean(axis=1), other[0][other[1]].mean(axis=1)) < 1e-15


def test_loop_on_an_octahedron_by_hand(x64):
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    tops = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2)]
    mesh = TriangleMesh(axes, np.array([*tops, *[(b, a, 5) for a, b, _ in tops]]))
    for scheme, share in ((Loop(), 1 - 31 / 64), (Loop(Warren()), 5 / 8)):
        vertices, _, _, _ = refined(mesh, 1, scheme)
        # The four neighbors of a vertex cancel, and so do the corners opposite an edge.
        np.testing.assert_allclose(vertices[:6], share * axes, atol=1e-15)
        middles = [axes[a] + axes[b] for a, b in edges_of(mesh)]
        assert gap(vertices[6:], 3 / 8 * np.array(middles)) < 1e-15


def test_loop_at_a_border_by_hand(x64):
    corners = np.array([[0.0, 0, 0], [8, 0, 0], [8, 8, 0], [0, 8, 8]])
    mesh = TriangleMesh(corners, np.array([(0, 1, 2), (0, 2, 3)]))
    vertices, _, _, _ = refined(mesh, 1, Loop())
    old = [[1, 1, 1], [7, 1, 0], [7, 7, 1], [1, 7, 6]]
    new = [[4, 0, 0], [8, 4, 0], [4, 8, 4], [0, 4, 4], [4, 4, 1]]
    np.testing.assert_allclose(vertices[:4], old, atol=1e-14)
    assert gap(vertices[4:], new) < 1e-14


def test_catmull_clark_on_a_cube_by_hand(x64):
    vertices, faces, _, _ = refined(cube(), 1, CatmullClark())
    corners = np.asarray(cube().vertices)
    # F = 1/3, R = 1/6, P = 0 in every coordinate of the corner at the origin.
    np.testing.assert_allclose(vertices[:8], 2 / 9 + 5 / 9 * corners, atol=1e-15)
    middles = corners[edges_of(cube())].mean(axis=1)
    assert (
        gap(vertices[8:20], np.where(middles == 0.5, 0.5, (6 * middles + 1) / 8))
        < 1e-15
    )
    assert gap(vertices[20:], corners[faces_of(cube())[0]].mean(axis=1)) < 1e-15
    assert faces[0].shape == (24, 4)


def test_catmull_clark_at_a_border_by_hand(x64):
    square = PolygonMesh(8.0 * np.eye(4, 3), np.array([[0, 1, 2, 3]]))
    vertices, _, _, _ = refined(square, 1, CatmullClark())
    np.testing.assert_allclose(vertices[0], [6, 1, 0], atol=1e-14)
    np.testing.assert_allclose(vertices[1], [1, 6, 1], atol=1e-14)
    np.testing.assert_allclose(vertices[-1], [2, 2, 2], atol=1e-14)


def test_catmull_clark_on_a_pentagon_by_hand(x64):
    mesh = house()
    plan = plan_subdivision(mesh, 1, scheme=CatmullClark())
    p, fine = np.asarray(mesh.vertices), plan.operator.to_scipy() @ mesh.vertices
    # Vertex 0 has three edges: one pentagon and two squares.
    f = [p[:5].mean(axis=0), p[[0, 1, 6, 5]].mean(axis=0), p[[4, 0, 5, 9]].mean(axis=0)]
    r = [(p[0] + p[k]) / 2 for k in (1, 4, 5)]
    np.testing.assert_allclose(
        fine[0], (np.mean(f, 0) + 2 * np.mean(r, 0)) / 3, atol=1e-14
    )
    edge = (p[0] + p[1] + f[0] + f[1]) / 4
    assert np.min(np.linalg.norm(fine - edge, axis=1)) < 1e-14
    assert plan.faces[0].shape[0] == 5 + 4 * 5 + 3 * 5


@ALL
def test_rows_are_partitions_of_unity(x64, case):
    mesh = case[0]()
    for creases in (None, some_creases(mesh)):
        s = plan_subdivision(mesh, 3, scheme=case[1], creases=creases).operator
        matrix = s.to_scipy()
        np.testing.assert_allclose(matrix.sum(axis=1), 1, atol=1e-13)
        assert matrix.min() >= 0


@ALL
def test_affine_maps_commute_with_subdivision(x64, case):
    mesh, generator = case[0](), np.random.default_rng(0)
    a, b = generator.normal(size=(3, 3)), generator.normal(size=3)
    matrix = plan_subdivision(
        mesh, 2, scheme=case[1], creases=some_creases(mesh)
    ).operator.to_scipy()
    moved = matrix @ (np.asarray(mesh.vertices) @ a + b)
    np.testing.assert_allclose(moved, (matrix @ mesh.vertices) @ a + b, atol=1e-12)


@ALL
def test_the_kind_of_surface_is_kept(case):
    mesh = case[0]()
    before = _counts(faces_of(mesh))
    plan = plan_subdivision(mesh, 2, scheme=case[1])
    after = _counts(faces_of(plan))
    assert before[:2] == after[:2]
    assert after[2] == 4 * before[2]


def _counts(groups):
    """Euler characteristic, whether closed and oriented, number of border edges."""
    directed = np.concatenate(
        [np.stack([f, np.roll(f, -1, axis=1)], -1).reshape(-1, 2) for f in groups]
    )
    edges, counts = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    assert len(np.unique(directed, axis=0)) == len(directed) and counts.max() <= 2
    euler = len(np.unique(directed)) - len(edges) + sum(len(f) for f in groups)
    return euler, bool(np.all(counts == 2)), int(np.sum(counts == 1))


def test_a_closed_mesh_stays_watertight():
    vertices, (faces,), _, _ = refined(hull(), 2, Loop())
    told = trimesh.Trimesh(vertices, faces, process=False)
    assert told.is_watertight and told.is_winding_consistent
    assert told.euler_number == 2 and told.volume > 0


@ALL
def test_levels_one_after_another_are_levels_at_once(x64, case):
    """But for the numbering of the new vertices; the faces are in the same order."""
    mesh, scheme = case[0](), case[1]
    creases = some_creases(mesh)
    at_once, faces, left, kind = refined(mesh, 3, scheme, creases)
    vertices, middle, creases, flat = refined(mesh, 1, scheme, creases)
    mesh = TriangleMesh(vertices, middle[0]) if flat else PolygonMesh(vertices, middle)
    vertices, steps, creases, flat = refined(mesh, 2, scheme, creases)
    assert flat == kind
    for a, b in zip(faces, steps, strict=True):
        np.testing.assert_allclose(at_once[a], vertices[b], atol=1e-13)
    sharp = lambda x, c: np.c_[x[c.edges].mean(axis=1), np.minimum(c.sharpness, 9)]
    if len(left.edges):
        assert gap(sharp(at_once, left), sharp(vertices, creases)) < 1e-12
    np.testing.assert_array_equal(left.vertices, creases.vertices)
    np.testing.assert_array_equal(left.vertex_sharpness, creases.vertex_sharpness)


def test_attributes_are_refined_like_positions(x64):
    mesh, colors = (
        hull(),
        np.random.default_rng(0).random((hull().vertices.shape[0], 4)),
    )
    told = TriangleMesh(
        mesh.vertices,
        mesh.faces,
        normals=mesh.vertices,
        attributes={"colors": colors, "x": mesh.vertices[:, 0]},
    )
    out = subdivide(told, 2)
    fine = out.mesh
    np.testing.assert_allclose(fine.attributes["x"], fine.vertices[:, 0], atol=1e-14)
    np.testing.assert_allclose(fine.attributes["colors"], out.operator @ colors)
    assert fine.normals is None


def test_shapes_are_batched_and_differentiated(x64):
    mesh = hull()
    faces = mesh.faces

    @jax.jit
    def volume(vertices):
        a, b, c = jnp.moveaxis(
            subdivide(TriangleMesh(vertices, faces), 2).mesh.triangles(), 1, 0
        )
        return jnp.sum(a * jnp.cross(b, c)) / 6

    x = jnp.asarray(mesh.vertices)
    direction = jnp.sin(7 * x)
    h = 1e-5
    both = jax.vmap(volume)(jnp.stack([x + h * direction, x - h * direction]))
    slope = jnp.vdot(jax.grad(volume)(x), direction)
    np.testing.assert_allclose((both[0] - both[1]) / (2 * h), slope, rtol=1e-8)


def test_padding_is_cut_off():
    mesh = icosphere(1)
    v, f = mesh.vertices.shape[0], mesh.faces.shape[0]
    longer = TriangleMesh(
        jnp.pad(mesh.vertices, ((0, 5), (0, 0)), constant_values=jnp.nan),
        jnp.pad(mesh.faces, ((0, 7), (0, 0)), constant_values=v + 5),
        num_vertices=v,
        num_faces=f,
    )
    np.testing.assert_array_equal(
        subdivide(longer, 1).mesh.vertices, subdivide(mesh, 1).mesh.vertices
    )


def test_no_level_is_the_mesh_itself():
    out = subdivide(house(), 0, scheme=CatmullClark())
    np.testing.assert_allclose(out.mesh.vertices, house().vertices, atol=1e-6)
    for a, b in zip(out.mesh.faces, house().faces, strict=True):
        np.testing.assert_array_equal(a, b)


def test_loose_vertices_stay():
    mesh = TriangleMesh(np.eye(4, 3) * 2, np.array([[0, 1, 2]]))
    out = subdivide(mesh, 2).mesh
    np.testing.assert_array_equal(out.vertices[3], [0, 0, 0])


TRIANGLE = np.array([[0, 1, 2]])
BAD = {
    "no faces": (np.zeros((0, 3), int), "must have faces"),
    "index out of range": (np.array([[0, 1, 9]]), "faces must name vertices 0 ... 4"),
    "negative index": (np.array([[0, 1, -1]]), "faces must name vertices 0 ... 4"),
    "vertex named twice": (np.array([[0, 1, 2], [1, 1, 3]]), "face 1 names one twice"),
    "edge of three faces": (
        np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]),
        r"first \(0, 1\) with 3 faces",
    ),
}


@pytest.mark.parametrize("case", BAD.values(), ids=BAD.keys())
def test_bad_meshes_are_errors(case):
    mesh = TriangleMesh(np.zeros((5, 3)), case[0])
    with pytest.raises(GeometryError, match=case[1]):
        subdivide(mesh, 1)


def test_bad_settings_are_errors():
    with pytest.raises(GeometryError, match="levels must be at least 0"):
        subdivide(hull(), -1)
    with pytest.raises(GeometryError, match="Loop's scheme needs faces of three"):
        subdivide(cube(), 1, scheme=Loop())
    with pytest.raises(GeometryError, match="less than 2.31 corners after 13 levels"):
        subdivide(hull(), 13)
    with pytest.raises(GeometryError, match="the faces must be known"):
        jax.jit(subdivide)(hull())
