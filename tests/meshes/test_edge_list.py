"""Edges and neighbors against counting, barycentric coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS
from jaxgeom.meshes import (
    Heat,
    Implicit,
    barycentric,
    boundary_vertices,
    cluster_vertices,
    edges,
    geodesic_distance,
    interpolate_normals,
    mean_curvature,
    principal_curvatures,
    sample_poisson_disk,
    sample_surface,
    smooth,
    solid_properties,
    vertex_neighbors,
    vertex_normals,
)
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import (
    central_difference,
    closed_meshes,
    cut,
    sized,
    stacked,
)

V, F = 130, 250


def both(mesh):
    return vertex_neighbors(mesh, capacity=9), boundary_vertices(mesh)


RUN = jax.jit(both)
SMALL = jax.jit(lambda m: (edges(m, capacity=40), vertex_neighbors(m, capacity=4)))


def case():
    """A torus with a hole, faces that name a vertex twice, and crowded edges."""
    mesh = cut(closed_meshes()["torus"])
    more = [[3, 3, 5], [0, 1, 50], [1, 0, 60]]
    return TriangleMesh(np.asarray(mesh.vertices), np.concatenate([mesh.faces, more]))


def by_counting(mesh):
    """edge -> its faces, in plain Python."""
    out = {}
    for number, face in enumerate(np.asarray(mesh.faces).tolist()):
        for i in range(3 if len(set(face)) == 3 else 0):
            out.setdefault(tuple(sorted((face[i], face[i - 2]))), []).append(number)
    return out


def test_edges_are_those_of_counting():
    mesh = case()
    found, truth = RUN(sized(mesh, V, F))[0].edge_list, by_counting(mesh)
    found = jax.tree.map(np.asarray, found)
    number = int(found.required_edges)
    assert number == len(truth) == found.mask.sum()
    names = [tuple(e) for e in found.vertices[:number].tolist()]
    assert names == sorted(truth)
    assert np.all(found.vertices[number:] == V) and np.all(found.faces[number:] == F)
    rows = zip(names, found.num_faces.tolist(), found.faces.tolist(), strict=False)
    for name, count, faces in rows:
        assert count == len(truth[name])
        real = [x for x in faces if x < F]
        assert set(real) <= set(truth[name]) and len(set(real)) == min(count, 2)
    proper = np.array([len(set(f)) == 3 for f in mesh.faces.tolist()])
    of_faces = found.of_faces[: len(proper)]
    ends = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], -1), axis=-1)
    np.testing.assert_array_equal(found.vertices[of_faces[proper]], ends[proper])
    assert np.all(of_faces[~proper] == len(found.mask))


def test_neighbors_are_those_of_the_edges():
    mesh = case()
    table, boundary = jax.tree.map(np.asarray, RUN(sized(mesh, V, F)))
    pairs = by_counting(mesh)
    for vertex in range(V):
        near = {a + b - vertex for a, b in pairs if vertex in (a, b)}
        listed = table.vertices[:, vertex].tolist()
        assert [x for x in listed if x < V] == sorted(near)
    there = table.vertices < V
    ends = table.edge_list.vertices[np.where(there, table.edges, 0)]
    other = ends.sum(axis=-1) - np.arange(V)
    np.testing.assert_array_equal(np.where(there, other, V), table.vertices)
    truth = {v for e, f in pairs.items() if len(f) == 1 for v in e}
    assert set(np.flatnonzero(boundary)) == truth


def test_too_small_capacities_are_told():
    mesh = sized(case(), V, F)
    full = RUN(mesh)[0]
    few, near = SMALL(mesh)
    assert few.required_edges == full.edge_list.required_edges > 40
    assert few.result == RESULTS.capacity_exceeded
    assert full.edge_list.result == full.result == RESULTS.successful
    np.testing.assert_array_equal(few.vertices, full.edge_list.vertices[:40])
    assert near.result == RESULTS.capacity_exceeded
    assert near.required_neighbors == full.required_neighbors > 4
    np.testing.assert_array_equal(near.vertices, full.vertices[:4])
    with pytest.raises(ValueError, match="capacity must be at least 1"):
        edges(mesh, capacity=0)


@pytest.mark.slow
def test_the_host_measures_the_capacity():
    mesh = sized(case(), V, F)
    measured = vertex_neighbors(mesh)
    assert measured.vertices.shape[0] == measured.required_neighbors <= 9
    assert measured.result == RESULTS.successful
    np.testing.assert_array_equal(
        measured.vertices, RUN(mesh)[0].vertices[: measured.vertices.shape[0]]
    )


@pytest.mark.slow
def test_vmap_is_loop():
    meshes = [sized(m, V, F) for m in (case(), cut(case(), -9))]
    batch = jax.jit(jax.vmap(both))(stacked(*meshes))
    for i, mesh in enumerate(meshes):
        pairs = zip(jax.tree.leaves(batch), jax.tree.leaves(RUN(mesh)), strict=True)
        for a, b in pairs:
            np.testing.assert_array_equal(a[i], b)


def test_no_edges():
    empty = TriangleMesh(np.zeros((3, 3)), np.zeros((0, 3), np.int32))
    table, boundary = RUN(sized(empty, V, F))
    assert table.edge_list.required_edges == table.required_neighbors == 0
    assert not np.any(boundary)
    assert jax.eval_shape(edges, empty).vertices.shape == (1, 2)


@pytest.mark.parametrize(
    "function",
    [
        lambda m: geodesic_distance(m, jnp.array([0])),
        lambda m: geodesic_distance(
            m, jnp.array([0]), Heat(vertex_neighbors(m, capacity=1))
        ),
        lambda m: smooth(m, Implicit(0.1)),
        lambda m: cluster_vertices(m, 0.1),
        lambda m: sample_poisson_disk(m, 0.1, capacity=3, key=jax.random.key(0)),
        mean_curvature,
        principal_curvatures,
        solid_properties,
    ],
)
def test_everything_can_be_traced_without_faces(function):
    empty = TriangleMesh(jnp.zeros((4, 3)), jnp.zeros((0, 3), jnp.int32))
    shapes = jax.tree.leaves(jax.eval_shape(function, empty))
    assert all(jnp.dtype(x.dtype).itemsize <= 4 for x in shapes if hasattr(x, "dtype"))


def shifted(mesh, key):
    """Samples, their triangles, and the coordinates of several points in them."""
    drawn = sample_surface(mesh, 60, key=key)
    triangles = mesh.triangles()[drawn.faces]
    far = jnp.array([2.0, -1.5, 0.5])
    locate = jax.vmap(barycentric)
    found = (
        locate(triangles, drawn.points),
        locate(triangles, drawn.points + 0.3 * drawn.normals),
        locate(triangles[..., :2], drawn.points[..., :2]),
        locate(triangles, jnp.einsum("i,nid->nd", far, triangles)) - far,
    )
    normals = interpolate_normals(mesh, drawn.faces, drawn.barycentric)
    ends = jnp.tile(jnp.eye(3)[1], (60, 1))
    at_corner = interpolate_normals(mesh, drawn.faces, ends)
    expected = vertex_normals(mesh)[mesh.faces[drawn.faces, 1]]
    own = jnp.broadcast_to(jnp.array([0.0, 2.0, 0.0]), mesh.vertices.shape)
    given = interpolate_normals(mesh, drawn.faces, drawn.barycentric, normals=own)
    none = interpolate_normals(mesh, jnp.full(60, F), drawn.barycentric)
    return drawn, found, (normals, at_corner - expected, given, none)


def test_barycentric_coordinates_and_normals(x64):
    mesh = sized(closed_meshes()["torus"], V, F)
    drawn, found, normals = jax.jit(shifted)(mesh, jax.random.key(1))
    for x, tolerance in zip(found[:3], (1e-10, 1e-10, 1e-8), strict=True):
        np.testing.assert_allclose(x, drawn.barycentric, atol=tolerance)
    np.testing.assert_allclose(found[3], 0, atol=1e-9)
    smooth, at_corner, given, none = (np.asarray(x) for x in normals)
    np.testing.assert_allclose(np.linalg.norm(smooth, axis=1), 1, atol=1e-12)
    assert np.all(np.sum(smooth * np.asarray(drawn.normals), axis=1) > 0.7)
    np.testing.assert_allclose(at_corner, 0, atol=1e-12)
    assert np.all(given == [0, 1, 0]) and np.all(none == 0)


def test_barycentric_coordinates_in_triangles_without_area(x64):
    point = jnp.array([0.7, 5.0, 1.0])
    both = jax.jit(
        lambda t: (barycentric(t, point), jax.jacobian(barycentric)(t, point))
    )
    line = jnp.array([[0.2, 0.1, 0.0], [2.2, 0.1, 0.0], [1.2, 0.1, 0.0]])
    np.testing.assert_allclose(both(line)[0], [0.75, 0.25, 0], atol=1e-12)
    assert np.sum(both(jnp.ones((3, 3)))[0]) == 1
    for triangle in (line, jnp.ones((3, 3))):
        assert np.all(np.isfinite(both(triangle)[1]))
    with pytest.raises(ValueError, match="triangle must have shape"):
        barycentric(jnp.zeros((4, 3)), jnp.zeros(3))


def test_barycentric_gradients_are_central_differences(x64):
    probe, start = (
        np.array([0.3, -1.1, 0.7]),
        np.random.default_rng(2).normal(size=(4, 3)),
    )
    function = lambda x: probe @ barycentric(x[:3], x[3])
    way = np.random.default_rng(3).normal(size=(4, 3))
    numeric = central_difference(function, start, way)
    slope = np.vdot(jax.jit(jax.grad(function))(start), way)
    assert slope == pytest.approx(float(numeric), rel=1e-7)
