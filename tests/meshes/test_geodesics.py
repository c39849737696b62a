"""Distances along surfaces: exact cases, convergence, statuses, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS
from jaxgeom.meshes import (
    Heat,
    Unfolding,
    geodesic_distance,
    icosphere,
    vertex_neighbors,
)
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import (
    bent,
    closed_meshes,
    flat_patch,
    joined,
    moved,
    sized,
    slope_and_difference,
)

V, F = 700, 1300


def by_unfolding(mesh, sources):
    return geodesic_distance(mesh, sources)


def by_heat(mesh, sources):
    table = vertex_neighbors(mesh, capacity=9)
    return geodesic_distance(mesh, sources, Heat(table, rtol=1e-6))


RUN = {"unfolding": jax.jit(by_unfolding), "heat": jax.jit(by_heat)}


def run(name, mesh, sources):
    padded = np.full(3, V, np.int32)
    padded[: len(sources)] = sources
    found = RUN[name](sized(mesh, V, F), padded)
    return jax.tree.map(np.asarray, found)


def arcs(mesh, source, radius=1.3):
    """Great-circle distances."""
    unit = np.asarray(mesh.vertices) / radius
    return radius * np.arccos(np.clip(unit @ unit[source], -1, 1))


@pytest.mark.parametrize("name", RUN)
def test_spheres_converge(x64, name):
    errors = []
    for n in (2, 3):
        mesh = icosphere(n, radius=1.3)
        found = run(name, mesh, [5])
        assert found.result == RESULTS.successful and found.steps > 10
        truth = arcs(mesh, 5)
        errors.append(np.mean(np.abs(found.distances[: len(truth)] - truth)))
        assert found.distances[5] == 0
    # Both are at least of first order in the length of the edges.
    assert np.log2(errors[0] / errors[1]) > 0.9
    assert errors[1] < 0.01 * np.pi * 1.3


def test_a_plane_is_exact_for_unfolding(x64):
    # A convex plane: the shortest way is the straight line.
    i, j = (x.ravel() for x in np.meshgrid(range(9), range(7), indexing="ij"))
    jitter = np.random.default_rng(0).uniform(-0.2, 0.2, (2, 63))
    u, w = i + jitter[0] * (i % 8 > 0), j + jitter[1] * (j % 6 > 0)
    node = lambda di, dj: ((i + di) * 7 + j + dj)[(i < 8) & (j < 6)]
    lower = np.stack([node(0, 0), node(1, 0), node(1, 1)], -1)
    upper = np.stack([node(0, 0), node(1, 1), node(0, 1)], -1)
    faces = np.concatenate([lower, upper])
    mesh = TriangleMesh(np.stack([u, 0.6 * w, 0.8 * w], -1), faces)
    found = run("unfolding", mesh, [24])
    truth = np.linalg.norm(mesh.vertices - mesh.vertices[24], axis=1)
    gap = found.distances[:63] - truth
    assert np.min(gap) > -1e-12
    # Lines through a vertex may be lost to the sides of a triangle.
    assert (
        np.quantile(gap / truth.max(), 0.9) < 1e-12 and np.max(gap / truth.max()) < 0.01
    )


def test_several_sources_and_pieces(x64):
    ball = icosphere(2, radius=1.3)
    mesh = joined(ball, moved(ball, (5.0, 0, 0)), moved(flat_patch(), (0, 9.0, 0)))
    for name in RUN:
        found = run(name, mesh, [5, 162 + 7])
        assert found.result == RESULTS.successful
        assert np.all(np.isinf(found.distances[324:]))
        assert found.distances[5] == 0 and np.all(found.distances[:324] >= -1e-6)
        for first, source in ((0, 5), (162, 7)):
            there = found.distances[first : first + 162]
            assert np.max(np.abs(there - arcs(ball, source))) < 0.2
    two = run("unfolding", ball, [5, 90]).distances[:162]
    each = [run("unfolding", ball, [s]).distances[:162] for s in (5, 90)]
    np.testing.assert_allclose(two, np.minimum(*each), atol=0.02)
    assert np.all(two <= np.minimum(*each) + 1e-12)


@pytest.mark.parametrize("name", RUN)
def test_distances_follow_scale_and_position(x64, name):
    mesh = closed_meshes()["torus"]
    plain = run(name, mesh, [11]).distances
    large = TriangleMesh(30.0 * np.asarray(mesh.vertices) + 4, mesh.faces)
    v = mesh.vertices.shape[0]
    np.testing.assert_allclose(
        run(name, large, [11]).distances[:v], 30 * plain[:v], rtol=1e-5, atol=1e-4
    )
    assert np.all(np.isinf(plain[v:]))


def test_faces_without_area_do_no_harm(x64):
    mesh = closed_meshes()["sphere"]
    vertices = np.asarray(mesh.vertices).copy()
    near = np.asarray(mesh.faces)[30]
    vertices[near[1]] = vertices[near[0]]
    broken = TriangleMesh(vertices, np.concatenate([mesh.faces, [[3, 3, 8]]]))
    for name in RUN:
        found = run(name, broken, [60])
        assert found.result == RESULTS.successful
        there = found.distances[: len(vertices)]
        plain = run(name, mesh, [60]).distances[: len(vertices)]
        others = np.setdiff1d(np.arange(len(vertices)), near)
        assert np.all(np.isfinite(there))
        assert np.max(np.abs(there - plain)[others]) < 0.1 * np.max(plain)


def test_gradients_are_central_differences(x64):
    _check_gradient(by_unfolding, 1e-7)


@pytest.mark.slow
def test_heat_gradients_are_central_differences(x64):
    def tight(mesh, sources):
        method = Heat(vertex_neighbors(mesh, capacity=9), rtol=1e-12)
        return geodesic_distance(mesh, sources, method)

    _check_gradient(tight, 1e-5)


def _check_gradient(measure, tolerance):
    mesh = sized(bent(icosphere(2)), 170, 330, garbage=3.0)
    counts = {"num_vertices": mesh.num_vertices, "num_faces": mesh.num_faces}
    generator = np.random.default_rng(0)
    probe, way = generator.normal(size=170), generator.normal(size=(170, 3))
    start = np.asarray(mesh.vertices) + 0.02 * generator.normal(size=(170, 3))

    def value(x):
        found = measure(TriangleMesh(x, mesh.faces, **counts), jnp.array([3, 90]))
        reached = jnp.isfinite(found.distances)
        return jnp.sum(probe * jnp.where(reached, found.distances, 0))

    slope, exact, numeric = slope_and_difference(value, start, way)
    assert exact == pytest.approx(numeric, rel=tolerance)
    assert np.all(slope[162:] == 0)


@pytest.mark.slow
def test_a_batch_in_single_precision_is_each_in_double():
    mesh = closed_meshes()["torus"]
    small = sized(mesh, V, F, dtype=np.float32)
    sources = np.array([[3, V, V], [70, 11, V]], np.int32)
    batch = jax.jit(jax.vmap(by_unfolding, (None, 0)))(small, sources)
    assert batch.distances.dtype == np.float32
    assert np.all(batch.result == RESULTS.successful)
    with jax.enable_x64(True):
        for i, some in enumerate(([3], [70, 11])):
            one = run("unfolding", mesh, some)
            np.testing.assert_allclose(batch.distances[i], one.distances, rtol=1e-3)


def test_statuses(x64):
    mesh = icosphere(2)
    for name in RUN:
        nowhere = run(name, mesh, [])
        assert nowhere.result == RESULTS.degenerate_input
        assert np.all(np.isinf(nowhere.distances))
        assert run(name, mesh, [-1]).result == RESULTS.degenerate_input
    small = sized(mesh, V, F)
    late = jax.jit(
        lambda m: geodesic_distance(m, jnp.array([5]), Unfolding(max_steps=3))
    )
    assert late(small).result == RESULTS.not_converged
    with pytest.raises(ValueError, match="sources must have shape"):
        geodesic_distance(small, jnp.int32(4))


@pytest.mark.slow
def test_heat_statuses(x64):
    small = sized(icosphere(2), V, F)
    few = vertex_neighbors(small, capacity=4)
    found = jax.jit(lambda m: geodesic_distance(m, jnp.array([5]), Heat(few)))(small)
    assert found.result == RESULTS.capacity_exceeded
    table = vertex_neighbors(small)
    late = Heat(table, max_steps=4)
    found = jax.jit(lambda m: geodesic_distance(m, jnp.array([5]), late))(small)
    assert found.result == RESULTS.not_converged


@pytest.mark.slow
def test_large_single_precision_meshes_converge():
    mesh = icosphere(5, radius=1.3)
    truth = arcs(mesh, 5)
    for method, bound in ((Unfolding(), 0.004), (Heat(), 0.013)):
        found = geodesic_distance(mesh, jnp.array([5]), method)
        assert found.result == RESULTS.successful
        assert np.mean(np.abs(found.distances - truth)) < bound
