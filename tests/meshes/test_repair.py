"""Reports of provoked defects, and what repairs them."""

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxgeom.meshes import (
    boundary_loops,
    box_mesh,
    check_mesh,
    clean,
    fill_holes,
    icosphere,
    orient,
    repair,
    report,
    split_vertices,
    torus_mesh,
    volume,
    weld,
)
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import (
    bent,
    closed_meshes,
    cut,
    flat_patch,
    joined,
    moved,
    padded,
    peer,
    sized,
    with_faces,
)


def host(mesh, faces=None, vertices=None):
    """The mesh as numpy arrays, some of them replaced."""
    vertices = np.asarray(mesh.vertices if vertices is None else vertices)
    return TriangleMesh(vertices, np.asarray(mesh.faces if faces is None else faces))


def soup(mesh):
    """Every face with vertices of its own."""
    faces = np.asarray(mesh.faces)
    corners = np.asarray(mesh.vertices)[faces.reshape(-1)]
    return TriangleMesh(corners, np.arange(faces.size).reshape(-1, 3))


def moebius(n=20):
    i = np.arange(n)
    t = 2 * np.pi * i / n
    edge = lambda s: np.stack(
        [
            (1 + s * np.cos(t / 2)) * np.cos(t),
            (1 + s * np.cos(t / 2)) * np.sin(t),
            s * np.sin(t / 2),
        ],
        -1,
    )
    vertices = np.stack([edge(-0.3), edge(0.3)], 1).reshape(-1, 3)
    node = lambda k, s: np.where(k < n, 2 * k + s, 1 - s)
    lower = np.stack([node(i, 0), node(i + 1, 0), node(i + 1, 1)], -1)
    upper = np.stack([node(i, 0), node(i + 1, 1), node(i, 1)], -1)
    return TriangleMesh(vertices, np.concatenate([lower, upper]))


def defects(mesh):
    return {name: n for name, n in report(mesh).counts().items() if n}


def closed_loops_are_in_order(mesh):
    """Every step of every boundary loop is a directed edge of one face."""
    faces = np.asarray(mesh.faces)
    steps = {(f[i], f[(i + 1) % 3]) for f in faces.tolist() for i in range(3)}
    for loop in boundary_loops(mesh):
        for a, b in zip(loop.tolist(), np.roll(loop, -1).tolist(), strict=True):
            assert (a, b) in steps and (b, a) not in steps
    return [len(loop) for loop in boundary_loops(mesh)]


def test_clean_meshes_are_clean():
    for mesh in closed_meshes().values():
        found = report(padded(mesh))
        assert found.is_clean and "no defects" in str(found)
        assert found.num_components == 1
        assert found.euler == peer(mesh).euler_number
        check_mesh(mesh)


def test_every_defect_is_found_where_it_is():
    ball = icosphere(1)
    v = ball.vertices.shape[0]
    vertices = np.concatenate([ball.vertices, [[9.0, 9, 9], [np.nan, 0, 0]]])
    faces = np.asarray(ball.faces)
    more = np.array([[3, 3, 5], faces[11][[1, 2, 0]], [2, 4, 99], [0, 1, -1]])
    mesh = TriangleMesh(vertices, np.concatenate([faces, more]))
    found = report(mesh)
    assert found.degenerate_faces.tolist() == [80]
    assert found.duplicate_faces.tolist() == [81]
    assert found.out_of_range_faces.tolist() == [82, 83]
    assert found.unreferenced_vertices.tolist() == [v, v + 1]
    assert found.nonfinite_vertices.tolist() == [v + 1]
    sides = {tuple(sorted((faces[11][i], faces[11][i - 1]))) for i in range(3)}
    assert {tuple(e) for e in found.nonmanifold_edges.tolist()} == sides
    middle = found.positions("duplicate_faces")[0]
    np.testing.assert_allclose(middle, vertices[faces[11]].mean(axis=0), atol=1e-6)
    assert np.all(np.isnan(found.positions("out_of_range_faces")))
    np.testing.assert_array_equal(
        found.positions("unreferenced_vertices")[0], [9, 9, 9]
    )
    words = str(found)
    for part in ("84 faces", "1 duplicate faces", "(9, 9, 9)", "2 out of range faces"):
        assert part in words
    with pytest.raises(ValueError, match="name must be one of nonmanifold_edges"):
        found.positions("nonsense")


def test_bow_ties_and_windings_are_found():
    ball = icosphere(1)
    v = ball.vertices.shape[0]
    two = joined(ball, moved(ball, (3.0, 0.2, 0.1)))
    tied = host(two, np.where(np.asarray(two.faces) == v + 4, 2, two.faces))
    found = report(tied)
    assert found.nonmanifold_vertices.tolist() == [2] and found.num_components == 2
    faces = np.array(ball.faces)
    faces[7] = faces[7, ::-1]
    wrong = report(host(ball, faces))
    sides = {tuple(sorted((faces[7][i], faces[7][i - 1]))) for i in range(3)}
    assert {tuple(e) for e in wrong.inconsistent_edges.tolist()} == sides
    inward = joined(ball, with_faces(moved(ball, (5.0, 0, 0)), ball.faces[:, ::-1]))
    assert report(inward).inward_faces.tolist() == list(range(80, 160))


def test_check_mesh_tells_what_is_wrong():
    ball = icosphere(1)
    empty = TriangleMesh(np.zeros((3, 3)), np.zeros((0, 3), np.int32))
    with pytest.raises(ValueError, match="a mesh needs at least one face; given: 0"):
        check_mesh(padded(empty))
    far = host(ball, np.concatenate([ball.faces, [[0, 1, 42]]]))
    with pytest.raises(ValueError, match="from 0 to 41; given: 1 faces .* face 80"):
        check_mesh(far)
    holed = np.array(ball.vertices)
    holed[int(ball.faces[3, 0])] = np.nan
    with pytest.raises(ValueError, match="vertices of faces must be finite"):
        check_mesh(host(ball, vertices=holed))
    assert check_mesh(moebius()) is not None


def test_boundary_loops_are_walks_of_directed_edges():
    torus = torus_mesh(around=13, across=9)
    keep = np.ones(234, bool)
    keep[[0, 60, 61]] = False
    assert sorted(closed_loops_are_in_order(host(torus, torus.faces[keep]))) == [3, 6]
    assert closed_loops_are_in_order(flat_patch()) == [22]
    assert closed_loops_are_in_order(icosphere(1)) == []
    assert [len(x) for x in boundary_loops(moebius())] == [40]
    # Two triangles that touch in a vertex have one boundary each.
    tie = TriangleMesh(
        np.random.default_rng(0).normal(size=(5, 3)), np.array([[0, 1, 2], [0, 3, 4]])
    )
    assert closed_loops_are_in_order(tie) == [3, 3]


def test_welding_undoes_a_soup():
    for mesh in closed_meshes().values():
        split = padded(soup(mesh))
        done = weld(split)
        number = mesh.vertices.shape[0]
        assert done.merged_vertices == 3 * mesh.faces.shape[0] - number
        assert defects(done.mesh) == {}
        np.testing.assert_array_equal(
            done.mesh.vertices[done.mesh.faces], np.asarray(mesh.vertices)[mesh.faces]
        )
        other = trimesh.Trimesh(np.asarray(split.trim().vertices), split.trim().faces)
        assert len(other.vertices) == number
        assert weld(done.mesh).merged_vertices == 0


def test_welding_within_a_distance():
    mesh = bent(icosphere(1))
    split = soup(mesh)
    noise = np.random.default_rng(0).uniform(-1, 1, split.vertices.shape) * 1e-3
    shaken = host(split, vertices=split.vertices + noise)
    assert weld(shaken).merged_vertices == 0
    done = weld(shaken, tolerance=5e-3)
    assert done.mesh.vertices.shape == mesh.vertices.shape and defects(done.mesh) == {}
    lost = np.array(split.vertices)
    lost[::7] = np.nan
    assert (
        np.sum(np.isnan(np.asarray(weld(host(split, vertices=lost)).mesh.vertices)))
        == 105
    )
    with pytest.raises(ValueError, match="tolerance must be a length of at least 0"):
        weld(mesh, tolerance=-1.0)


def test_attributes_follow():
    mesh = soup(icosphere(1))
    named = TriangleMesh(
        mesh.vertices, mesh.faces, mesh.vertices, {"x": mesh.vertices[:, 0] * 2}
    )
    done = repair(
        TriangleMesh(named.vertices, named.faces[1:], named.normals, named.attributes)
    )
    out = done.mesh
    assert done.filled_holes == 1 and defects(out) == {}
    np.testing.assert_allclose(out.attributes["x"], 2 * out.vertices[:, 0])
    np.testing.assert_allclose(out.normals, out.vertices)


def test_cleaning_leaves_what_is_sound():
    ball = icosphere(1)
    vertices = np.concatenate([ball.vertices, [[9.0, 9, 9], [np.nan, 0, 0]]])
    a, b, _ = np.asarray(ball.faces)[0]
    flat = np.array([[3, 3, 5], [a, b, 42], [2, 4, 99], ball.faces[11], [5, 6, 43]])
    mesh = TriangleMesh(vertices, np.concatenate([flat[:3], ball.faces, flat[3:]]))
    # Vertex 42 is far away, but there: its face is a fin.
    done = clean(mesh)
    assert done.removed_faces == 4 and done.removed_vertices == 1
    assert defects(done.mesh) == {"nonmanifold_edges": 1, "boundary_loops": 1}
    assert str(done) == "4 removed faces, 1 removed vertices"
    assert str(clean(ball)) == "nothing to repair"


def test_orienting_undoes_random_flips():
    torus = closed_meshes()["torus"]
    hole = cut(bent(icosphere(2)), -30)
    mesh = joined(torus, moved(hole, (9.0, 0, 0)))
    flips = np.random.default_rng(0).random(mesh.faces.shape[0]) < 0.4
    mixed = host(
        mesh, np.where(flips[:, None], np.asarray(mesh.faces)[:, ::-1], mesh.faces)
    )
    done = orient(padded(mixed))
    assert done.flipped_faces == flips.sum() and done.not_orientable == 0
    np.testing.assert_array_equal(np.sort(done.mesh.faces), np.sort(mesh.faces))
    assert defects(done.mesh) == defects(mesh)
    inside_out = orient(host(torus, np.asarray(torus.faces)[:, ::-1]))
    assert inside_out.flipped_faces == 234
    assert volume(inside_out.mesh) == pytest.approx(float(volume(torus)), rel=1e-6)
    strip = orient(moebius())
    assert (strip.not_orientable, strip.flipped_faces) == (40, 0)


def test_bow_ties_are_split():
    ball = icosphere(1)
    two = joined(ball, moved(ball, (3.0, 0.2, 0.1)))
    tied = host(two, np.where(np.asarray(two.faces) == 46, 2, two.faces))
    done = split_vertices(tied)
    assert done.added_vertices == 1 and report(done.mesh).nonmanifold_vertices.size == 0
    assert report(done.mesh).num_components == 2


def test_small_holes_are_filled():
    ball = bent(icosphere(2))
    faces = np.asarray(ball.faces)
    ring = np.any(np.isin(faces, [5, 50, 51]), axis=1)
    holed = host(ball, faces[~ring])
    before = report(holed).counts()["boundary_loops"]
    done = fill_holes(holed)
    assert done.filled_holes == before > 0 and done.holes_left == 0
    found = report(done.mesh)
    assert set(defects(done.mesh)) == {"unreferenced_vertices"} and found.euler == 2
    assert 0.97 < float(volume(done.mesh)) / float(volume(ball)) < 1
    longest = max(len(x) for x in boundary_loops(holed))
    few = fill_holes(holed, max_edges=longest - 1)
    assert few.holes_left >= 1 and few.filled_holes == before - few.holes_left
    assert fill_holes(holed, max_length=0.01).filled_holes == 0


def test_holes_of_known_area():
    # The lid of a box: four corners, and no vertex within. Flat, so its area is known.
    box = box_mesh((0.7, 2.1, 1.3))
    lid = np.all(np.asarray(box.vertices)[np.asarray(box.faces)][..., 2] > 0, axis=1)
    done = fill_holes(host(box, np.asarray(box.faces)[~lid]))
    assert done.added_faces == 2 and defects(done.mesh) == {}
    assert volume(done.mesh) == pytest.approx(0.7 * 2.1 * 1.3, rel=1e-6)
    # With vertices in line on its sides, that must not make faces without area.
    fine = box_mesh((0.7, 2.1, 1.3), subdivisions=2)
    lid = np.all(
        np.asarray(fine.vertices)[np.asarray(fine.faces)][..., 2] > 0.64, axis=1
    )
    done = fill_holes(host(fine, np.asarray(fine.faces)[~lid]))
    assert set(defects(done.mesh)) == {"unreferenced_vertices"}
    assert volume(done.mesh) == pytest.approx(0.7 * 2.1 * 1.3, rel=1e-6)


def test_long_holes_get_a_middle():
    tube = torus_mesh(1.0, 0.25, around=200, across=4)
    keep = np.asarray(tube.vertices)[np.asarray(tube.faces)][..., 2].max(axis=1) < 0.2
    done = fill_holes(host(tube, np.asarray(tube.faces)[keep]), max_edges=500)
    assert done.added_vertices == done.filled_holes == 2
    assert report(done.mesh).counts()["boundary_loops"] == 0


def test_a_single_triangle_is_no_hole():
    one = TriangleMesh(np.eye(3), np.array([[0, 1, 2]]))
    assert fill_holes(one).added_faces == 0


def test_everything_at_once():
    ball = bent(icosphere(2))
    faces = np.asarray(ball.faces)
    kept = faces[~np.any(np.isin(faces, [5, 50]), axis=1)]
    flips = np.random.default_rng(1).random(len(kept)) < 0.3
    kept = np.where(flips[:, None], kept[:, ::-1], kept)
    broken = soup(host(ball, np.concatenate([kept, kept[:3], [[7, 7, 8]]])))
    done = repair(sized(broken, 1200, 400, dtype=np.float32))
    assert defects(done.mesh) == {}
    assert report(done.mesh).euler == 2 and done.removed_faces == 4
    assert float(volume(done.mesh)) > 0.97 * float(volume(ball))
    assert "merged vertices" in str(done) and done.holes_left == 0
    nothing = repair(TriangleMesh(jnp.zeros((2, 3)), jnp.zeros((0, 3), jnp.int32)))
    assert nothing.mesh.faces.shape == (0, 3) and nothing.removed_vertices == 1
