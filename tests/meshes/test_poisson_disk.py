"""Poisson disks: nothing too near, no gap left, gradients, statuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial

from jaxgeom._core import RESULTS
from jaxgeom.meshes import (
    disk_radius,
    icosphere,
    interpolate,
    sample_poisson_disk,
    sample_surface,
)
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import closed_meshes, cut, sized, stacked

V, F, CAPACITY = 170, 330, 60


def draw(mesh, radius, key):
    drawn = sample_poisson_disk(mesh, radius, capacity=CAPACITY, key=key)
    there = interpolate(
        mesh, mesh.vertices, drawn.samples.faces, drawn.samples.barycentric
    )
    return drawn, there


RUN = jax.jit(draw)
CANDIDATES = jax.jit(lambda m, k: sample_surface(m, 12 * CAPACITY, key=k))


def run(mesh, radius, seed, dtype=float):
    return RUN(sized(mesh, V, F, dtype), radius, jax.random.key(seed))


@pytest.mark.parametrize("name", ["torus", "open", "sphere"])
def test_no_two_are_near_and_no_candidate_is_far(x64, name):
    mesh = {**closed_meshes(), "open": cut(closed_meshes()["torus"])}[name]
    radius = float(disk_radius(mesh, 50))
    for seed in (1, 2):
        drawn, there = run(mesh, radius, seed)
        number = int(drawn.required_samples)
        assert drawn.result == RESULTS.successful and 40 <= number <= 60
        points = np.asarray(drawn.samples.points)[:number]
        assert scipy.spatial.distance.pdist(points).min() >= radius
        np.testing.assert_allclose(points, there[:number], atol=1e-12)
        assert np.all(drawn.samples.mask == (np.arange(CAPACITY) < number))
        candidates = CANDIDATES(sized(mesh, V, F), jax.random.key(seed)).points
        gap = scipy.spatial.cKDTree(points).query(np.asarray(candidates))[0]
        assert gap.max() < radius
        # The very first candidate always stands.
        np.testing.assert_array_equal(points[0], candidates[0])


def test_it_is_dart_throwing_one_after_the_other(x64):
    # With a radius beyond all cells every round takes one point, as a loop would.
    mesh = icosphere(2)
    points = np.asarray(CANDIDATES(sized(mesh, V, F), jax.random.key(3)).points)
    radius, taken = 0.9, []
    for point in points:
        if all(np.linalg.norm(point - other) >= radius for other in taken):
            taken.append(point)
    drawn, _ = run(mesh, radius, 3)
    found = np.asarray(drawn.samples.points)[: int(drawn.required_samples)]
    apart = scipy.spatial.distance.pdist(found)
    assert apart.min() >= radius and abs(len(found) - len(taken)) <= 3
    np.testing.assert_array_equal(found[0], taken[0])


def test_a_radius_of_zero_takes_everything(x64):
    drawn, _ = run(icosphere(2), 0.0, 0)
    assert drawn.required_samples == 12 * CAPACITY
    assert drawn.result == RESULTS.capacity_exceeded
    assert np.all(drawn.samples.mask)


def test_gradients_reach_the_vertices(x64):
    mesh = sized(cut(closed_meshes()["torus"]), V, F, garbage=1.0)
    counts = {"num_vertices": mesh.num_vertices, "num_faces": mesh.num_faces}
    make = lambda x: TriangleMesh(x, mesh.faces, **counts)
    probe = jnp.asarray(np.random.default_rng(0).normal(size=(CAPACITY, 3)))

    def probed(x):
        drawn, _ = draw(make(x), 0.6, jax.random.key(5))
        return jnp.sum(probe * drawn.samples.points), drawn.samples

    slope, samples = jax.jit(jax.grad(probed, has_aux=True))(mesh.vertices)
    expected = np.zeros((V, 3))
    rows = np.asarray(mesh.faces)[np.asarray(samples.faces)[np.asarray(samples.mask)]]
    share = np.asarray(samples.barycentric)[np.asarray(samples.mask)]
    parts = share[..., None] * np.asarray(probe)[np.asarray(samples.mask)][:, None]
    np.add.at(expected, rows, parts)
    np.testing.assert_allclose(slope, expected, atol=1e-12)


@pytest.mark.slow
def test_a_batch_is_each_alone():
    meshes = [
        sized(m, V, F, np.float32) for m in (icosphere(2), closed_meshes()["torus"])
    ]
    keys = jax.random.split(jax.random.key(0), 2)
    radius = np.float32(0.55)
    batch, _ = jax.jit(jax.vmap(draw, (0, None, 0)))(stacked(*meshes), radius, keys)
    for i, mesh in enumerate(meshes):
        one, _ = RUN(mesh, radius, keys[i])
        assert batch.required_samples[i] == one.required_samples
        np.testing.assert_allclose(
            batch.samples.points[i], one.samples.points, atol=1e-5
        )
        number = int(one.required_samples)
        apart = scipy.spatial.distance.pdist(np.asarray(one.samples.points)[:number])
        assert apart.min() >= radius * (1 - 1e-6)


def test_no_surface_and_errors(x64):
    empty = TriangleMesh(np.ones((4, 3)), np.array([[0, 1, 2]]))
    drawn, _ = run(empty, 0.3, 0)
    assert drawn.result == RESULTS.no_surface and drawn.required_samples == 0
    assert not np.any(drawn.samples.mask)
    with pytest.raises(ValueError, match="capacity must be at least 1"):
        sample_poisson_disk(empty, 0.3, capacity=0, key=jax.random.key(0))
