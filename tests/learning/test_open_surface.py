"""Open surfaces: dense points and meshes of unsigned fields."""

import jax
import jax.numpy as jnp
import numpy as np

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


def test_a_bowl_becomes_a_disk_with_one_rim():
    found = learning.open_surface(bowl, GRID)
    assert found.result == RESULTS.successful
    mesh = meshes.orient(meshes.weld(found.mesh).mesh).mesh
    about = meshes.topology(jax.tree.map(jnp.asarray, mesh))
    assert int(about.num_components) == 1
    assert int(about.euler) == 1
    assert int(about.boundary_edges) > 20
    away = jax.vmap(bowl)(jnp.asarray(found.mesh.vertices))
    assert float(away.max()) < 0.02
    used = meshes.face_areas(jax.tree.map(jnp.asarray, found.mesh)).sum()
    exact = 2 * np.pi * RADIUS * (RADIUS + HEIGHT)
    assert abs(float(used) - exact) < 0.15 * exact


def test_overflow_is_a_valid_prefix_and_no_surface_is_said():
    full = learning.open_surface(bowl, GRID)
    tight = jax.jit(lambda g: learning.open_surface_jit(bowl, g, capacity=(40, 30)))(
        GRID
    )
    assert tight.result == RESULTS.capacity_exceeded
    assert int(tight.required_vertices) == int(full.required_vertices)
    mesh = tight.mesh.trim()
    assert mesh.faces.size and mesh.faces.max() < len(mesh.vertices)
    nothing = learning.open_surface(lambda p: bowl(p) + 0.5, GRID)
    assert nothing.result == RESULTS.no_surface
    assert nothing.mesh.faces.shape[0] == 0


def test_dense_points_cover_the_bowl():
    dense = jax.jit(
        lambda g, k: learning.dense_points(bowl, g, 600, key=k, tolerance=0.002)
    )
    out = dense(GRID, jax.random.key(2))
    points = np.asarray(out.cloud.trim().points)
    assert out.result == RESULTS.successful and len(points) > 500
    assert float(jax.vmap(bowl)(jnp.asarray(points)).max()) <= 0.002
    assert points[:, 2].min() < -0.37 and points[:, 2].max() > HEIGHT - 0.03
    far = jax.jit(
        lambda g, k: learning.dense_points(
            lambda p: bowl(p) + 0.5, g, 50, key=k, tolerance=0.002
        )
    )(GRID, jax.random.key(2))
    assert far.result == RESULTS.no_surface and np.all(np.isfinite(far.cloud.points))


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
