"""Open surfaces: dense points and meshes of unsigned fields."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import RESULTS, Grid, learning, meshes

GRID = Grid(jnp.asarray([-0.62, -0.6, -0.58]), jnp.full(3, 0.06), (21, 22, 20))
RADIUS, HEIGHT = 0.41, -0.13


def bowl(p):
    """The distance to the part of a sphere below z = HEIGHT: a bowl with a rim.

    The nearest point lies on the sphere where its foot is below the rim, else on the
    rim itself.
    """
    rim = jnp.sqrt(RADIUS**2 - HEIGHT**2)
    across = jnp.sqrt(p[0] ** 2 + p[1] ** 2 + 1e-12)
    away = jnp.sqrt(across**2 + p[2] ** 2)
    foot = p[2] * RADIUS / away
    to_rim = jnp.sqrt((across - rim) ** 2 + (p[2] - HEIGHT) ** 2 + 1e-14)
    return jnp.where(foot <= HEIGHT, jnp.abs(away - RADIUS), to_rim)


class Lifted(eqx.Module):
    """The bowl's distance and `lift` more: with lift > 0 there is no surface."""

    lift: jax.Array

    def __call__(self, p):
        return bowl(p) + self.lift


BOWL, NOTHING = Lifted(jnp.asarray(0.0)), Lifted(jnp.asarray(0.5))


@pytest.mark.slow
def test_a_bowl_becomes_a_disk_with_one_rim():
    found = learning.open_surface(BOWL, GRID)
    assert found.result == RESULTS.successful
    mesh = jax.tree.map(jnp.asarray, found.mesh)
    about = jax.jit(meshes.topology)(mesh)
    assert int(about.num_components) == 1
    assert int(about.euler) == 1
    assert int(about.boundary_loops) == 1 and int(about.boundary_edges) > 20
    assert int(about.nonmanifold_edges) == 0
    away = jax.jit(jax.vmap(BOWL))(mesh.vertices)
    assert float(away.max()) < 0.02
    exact = 2 * np.pi * RADIUS * (RADIUS + HEIGHT)
    area = float(jax.jit(meshes.face_areas)(mesh).sum())
    assert abs(area - exact) < 0.15 * exact


@pytest.mark.slow
def test_overflow_is_a_valid_prefix_and_no_surface_is_said():
    capacity = (40, 30)
    tight = jax.jit(lambda f: learning.open_surface_jit(f, GRID, capacity=capacity))
    short, none = tight(BOWL), tight(NOTHING)
    assert short.result == RESULTS.capacity_exceeded
    assert int(short.required_vertices) > 100 and int(short.required_faces) > 200
    mesh = short.mesh.trim()
    assert len(mesh.vertices) == 40
    assert 0 < len(mesh.faces) <= 60 and mesh.faces.max() < 40
    assert none.result == RESULTS.no_surface
    assert int(none.mesh.num_faces) == 0 and np.all(np.isfinite(none.mesh.vertices))


def test_dense_points_cover_the_bowl():
    dense = jax.jit(
        lambda f, k: learning.dense_points(f, GRID, 600, key=k, tolerance=0.002)
    )
    out = dense(BOWL, jax.random.key(2))
    points = np.asarray(out.cloud.trim().points)
    assert out.result == RESULTS.successful and len(points) > 500
    assert len(points) == int(out.num_points)
    assert float(jax.vmap(bowl)(jnp.asarray(points)).max()) <= 0.0021
    assert points[:, 2].min() < -0.37 and points[:, 2].max() > HEIGHT - 0.03
    far = dense(NOTHING, jax.random.key(2))
    assert far.result == RESULTS.no_surface and np.all(np.isfinite(far.cloud.points))


@pytest.mark.slow
def test_samples_know_their_distance():
    ball = meshes.icosphere(2)
    ball = jax.tree.map(jnp.asarray, ball)
    run = jax.jit(
        lambda m, k: (
            learning.signed_samples(m, 90, key=k, reach=1.5),
            learning.unsigned_samples(m, 90, key=k, reach=1.5),
        )
    )
    signed, unsigned = run(ball, jax.random.key(0))
    away = np.linalg.norm(signed.points, axis=1) - 1
    np.testing.assert_allclose(signed.values, away, atol=0.05)
    np.testing.assert_allclose(np.abs(signed.values), unsigned.values, atol=1e-5)
    assert np.abs(away[:30]).max() < 0.1 < np.abs(away[60:]).max()
