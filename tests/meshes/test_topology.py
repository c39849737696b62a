"""Topology against trimesh, and provoked defects."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom.meshes import box_mesh, face_components, icosphere, topology, torus_mesh
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import (
    bent,
    closed_meshes,
    joined,
    moved,
    padded,
    peer,
    stacked,
    with_faces,
)

TOPOLOGY = jax.jit(topology)


def report(mesh):
    return jax.tree.map(lambda x: x.item(), TOPOLOGY(mesh))


@pytest.mark.parametrize("name", ["sphere", "box", "torus"])
def test_closed_meshes_agree_with_trimesh(name):
    mesh = closed_meshes()[name]
    t, other = report(mesh), peer(mesh)
    assert t.euler == other.euler_number
    assert t.num_components == other.body_count == 1
    assert bool(t.is_watertight) and other.is_watertight
    assert t.genus == (1 if name == "torus" else 0)
    assert t.boundary_edges == t.nonmanifold_edges == t.nonmanifold_vertices == 0
    assert t.duplicate_faces == t.degenerate_faces == 0


def test_random_soups_agree_with_counting(x64):
    generator = np.random.default_rng(5)
    for _ in range(6):
        faces = generator.integers(0, 12, (40, 3))
        mesh = TriangleMesh(
            jnp.asarray(generator.normal(size=(12, 3))), jnp.asarray(faces)
        )
        t = report(mesh)
        good = [f for f in faces.tolist() if len(set(f)) == 3]
        edges = [tuple(sorted((f[i], f[i - 1]))) for f in good for i in range(3)]
        _, counts = np.unique(edges, axis=0, return_counts=True)
        sets = np.unique([sorted(f) for f in good], axis=0)
        assert t.boundary_edges == np.sum(counts == 1)
        assert t.nonmanifold_edges == np.sum(counts > 2)
        assert t.duplicate_faces == len(good) - len(sets)
        assert t.degenerate_faces == len(faces) - len(good)
        assert t.euler == len(np.unique(good)) - len(counts) + len(good)
        assert t.num_components == _components_by_search(good)


def _components_by_search(faces):
    links = [
        [j for j, g in enumerate(faces) if len(set(f) & set(g)) >= 2] for f in faces
    ]
    seen, pieces = set(), 0
    for first in range(len(faces)):
        pieces += first not in seen
        front = [first]
        while front:
            here = front.pop()
            if here not in seen:
                seen.add(here)
                front += links[here]
    return pieces


def test_numbering_does_not_matter():
    mesh = joined(*closed_meshes().values(), moved(icosphere(1), (9.0, 0, 0)))
    generator = np.random.default_rng(2)
    names = generator.permutation(mesh.vertices.shape[0])
    rows = generator.permutation(mesh.faces.shape[0])
    faces = np.roll(names[np.asarray(mesh.faces)][rows], 1, axis=1)
    mixed = TriangleMesh(mesh.vertices[np.argsort(names)], jnp.asarray(faces))
    assert report(mixed) == report(mesh)
    assert report(mixed).num_components == 4
    assert report(mixed).genus == 1


def test_hole_is_found():
    mesh = icosphere(2)
    t = report(with_faces(mesh, mesh.faces[1:]))
    assert (t.boundary_edges, t.boundary_loops, t.euler, t.genus) == (3, 1, 1, 0)
    assert t.is_manifold and t.is_oriented and not t.is_closed


def test_two_holes_in_a_torus_are_two_loops():
    mesh = torus_mesh(around=13, across=9)
    keep = np.ones(mesh.faces.shape[0], bool)
    keep[[0, 60]] = False
    t = report(with_faces(mesh, mesh.faces[keep]))
    assert (t.boundary_loops, t.euler, t.genus) == (2, -2, 1)


def test_flipped_face_is_found():
    mesh = icosphere(2)
    t = report(with_faces(mesh, mesh.faces.at[7].set(mesh.faces[7, ::-1])))
    assert not t.is_oriented and t.is_closed and t.is_manifold
    assert not peer(
        with_faces(mesh, mesh.faces.at[7].set(mesh.faces[7, ::-1]))
    ).is_winding_consistent


def test_inside_out_is_still_oriented():
    mesh = icosphere(1)
    assert report(with_faces(mesh, mesh.faces[:, ::-1])).is_watertight


@pytest.mark.parametrize("flip", [False, True])
def test_duplicate_face_is_found(flip):
    mesh = icosphere(2)
    again = jnp.roll(mesh.faces[11], 1)
    again = again[::-1] if flip else again
    t = report(with_faces(mesh, jnp.concatenate([mesh.faces, again[None]])))
    assert t.duplicate_faces == 1
    assert t.nonmanifold_edges == 3
    assert t.is_closed and not t.is_manifold


def test_two_faces_back_to_back_are_closed_duplicates():
    mesh = TriangleMesh(jnp.eye(3), jnp.array([[0, 1, 2], [2, 1, 0]]))
    t = report(mesh)
    assert (t.duplicate_faces, t.euler, t.num_components) == (1, 2, 1)
    assert t.is_closed and t.is_oriented


def test_three_faces_on_an_edge():
    vertices = jnp.array(
        [[0, 0, 0], [0, 0, 1.3], [1, 0, 0], [0, 1.1, 0], [-1, -1, 0.2]]
    )
    t = report(TriangleMesh(vertices, jnp.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]])))
    assert (t.nonmanifold_edges, t.boundary_edges, t.num_components) == (1, 6, 1)
    assert not t.is_manifold and not t.is_oriented


def test_bow_ties_are_found():
    sphere = icosphere(1)
    v = sphere.vertices.shape[0]
    both = joined(sphere, moved(sphere, (3.0, 0.2, 0.1)))
    faces = jnp.where(both.faces == v + 4, 2, both.faces)
    t = report(with_faces(both, faces))
    assert (t.nonmanifold_vertices, t.nonmanifold_edges) == (1, 0)
    assert (t.euler, t.num_components) == (3, 2)
    assert t.is_closed and t.is_oriented and not t.is_manifold
    vertices = jnp.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 0, 0.3], [-1, -1, 0]])
    t = report(TriangleMesh(vertices, jnp.array([[0, 1, 2], [0, 3, 4]])))
    assert (t.nonmanifold_vertices, t.num_components) == (1, 2)


def test_degenerate_faces_are_counted():
    mesh = bent(icosphere(1))
    more = jnp.array([[3, 3, 5], [7, 8, 7]])
    t = report(with_faces(mesh, jnp.concatenate([mesh.faces, more])))
    assert t.degenerate_faces == 2
    assert bool(t.is_watertight) and t.euler == 2
    line = jnp.array([[0.1, 0.2, 0.3], [1.1, 1.2, 1.3], [2.1, 2.2, 2.3]])
    assert report(TriangleMesh(line, jnp.array([[0, 1, 2]]))).degenerate_faces == 1


def test_fan_of_many_faces_is_one_component():
    rim = np.arange(1, 5001)
    generator = np.random.default_rng(1)
    faces = np.stack([np.zeros_like(rim), rim, np.roll(rim, -1)], -1)
    faces = jnp.asarray(generator.permutation(faces))
    t = report(TriangleMesh(jnp.asarray(generator.normal(size=(5001, 3))), faces))
    assert (t.num_components, t.boundary_loops, t.boundary_edges) == (1, 1, 5000)
    assert t.is_manifold and t.is_oriented


def test_padding_changes_nothing():
    mesh = joined(closed_meshes()["torus"], icosphere(1))
    assert report(padded(mesh)) == report(mesh)


def test_vmap_is_loop():
    closed = icosphere(1)
    flipped = with_faces(closed, closed.faces.at[7].set(closed.faces[7, ::-1]))
    broken = with_faces(closed, closed.faces.at[3].set(closed.vertices.shape[0]))
    meshes = (closed, flipped, broken)
    batched = jax.jit(jax.vmap(topology))(stacked(*meshes))
    for i, mesh in enumerate(meshes):
        assert jax.tree.map(lambda x, i=i: x[i].item(), batched) == report(mesh)


def test_empty_mesh():
    empty = TriangleMesh(jnp.zeros((0, 3)), jnp.zeros((0, 3), jnp.int32))
    for mesh in (empty, padded(empty)):
        t = report(mesh)
        assert (t.euler, t.num_components, t.genus) == (0, 0, 0)
        assert not t.is_closed


def test_component_labels():
    mesh = padded(joined(icosphere(0), box_mesh(), icosphere(1)))
    found = face_components(mesh)
    assert found.num_components == 3
    numbers = np.asarray(found.labels)
    np.testing.assert_array_equal(np.unique(numbers[:112]), [0, 20, 32])
    assert np.all(numbers[112:] == mesh.faces.shape[0])


@pytest.mark.slow
def test_a_million_faces():
    mesh = torus_mesh(around=1000, across=500)
    t = report(mesh)
    assert (t.euler, t.genus, t.num_components) == (0, 1, 1)
    assert t.is_watertight
