"""A surface from bare points, by gradients through solver and extractor."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import RESULTS, GeometryError
from jaxgeom.meshes import topology
from jaxgeom.pipelines import shape_as_points
from jaxgeom.reconstruction import spectral_poisson
from jaxgeom.shapes import Grid, PointCloud

AXES, CENTER = np.array([10.0, 7.0, 8.0]), np.array([100.0, -30.0, 4.0])
SMALL = {"num_points": 500, "num_samples": 500}


def _scan(n, noise=0.0):
    rng = np.random.default_rng(0)
    x = rng.normal(size=(n, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return x * AXES + CENTER + noise * rng.normal(size=(n, 3))


def _miss(mesh):
    """How far vertices are from the ellipsoid, in shares of its radius there."""
    return np.abs(np.linalg.norm((mesh.vertices - CENTER) / AXES, axis=1) - 1)


@pytest.mark.slow
def test_a_sphere_becomes_the_scan():
    key = jax.random.key(1)
    run = lambda **rest: shape_as_points(_scan(600), key=key, **SMALL, **rest)
    found = run(resolutions=(16, 24), steps=(60, 40), rate=4e-3)
    assert found.result == RESULTS.successful
    check = topology(found.mesh)
    assert bool(check.is_closed) and int(check.euler) == 2
    assert _miss(found.mesh).mean() < 0.03 and _miss(found.mesh).max() < 0.2
    first = found.losses[0]
    assert len(first) == 60 and np.mean(first[-6:]) < 0.6 * first[0]
    assert 0.1 < float(found.error) < 1.5
    cloud = (np.asarray(found.cloud.points) - CENTER) / AXES
    outward = np.sum(cloud * np.asarray(found.cloud.normals), axis=1)
    assert np.mean(outward > 0) > 0.97
    with pytest.raises(GeometryError, match="number of steps"):
        shape_as_points(_scan(9), key=key, steps=(5,))
    with pytest.raises(GeometryError, match="coincide"):
        shape_as_points(np.ones((9, 3)), key=key)


@pytest.mark.slow
def test_noise_is_averaged():
    noisy = _scan(4000, noise=0.4)
    found = shape_as_points(
        noisy, key=jax.random.key(2), resolutions=(24, 32), steps=(200, 100), **SMALL
    )
    of_scan = np.abs(np.linalg.norm((noisy - CENTER) / AXES, axis=1) - 1)
    assert _miss(found.mesh).mean() < 0.5 * of_scan.mean()


def test_the_spectral_field_of_a_sphere_and_its_derivatives(x64):
    """Zero on the sphere that the points are on, growing outward; exact slopes."""
    i = np.arange(400) + 0.5
    z, turn = 1 - i / 200, np.pi * (1 + 5**0.5) * i
    unit = np.stack([*(np.sqrt(1 - z**2) * f(turn) for f in (np.cos, np.sin)), z], 1)
    points, grid = 0.5 * unit, Grid(jnp.full(3, -1.0), jnp.full(3, 0.1), (20,) * 3)
    values = spectral_poisson(points, unit, grid)
    assert abs(float(jnp.mean(values))) < 1e-9
    radius = np.linalg.norm(np.asarray(grid.nodes()), axis=-1)
    inside, outside = values[radius < 0.35], values[(radius > 0.65) & (radius < 0.9)]
    assert float(inside.max()) < float(outside.min())
    level = (float(inside.mean()) + float(outside.mean())) / 2
    near = values[np.abs(radius - 0.5) < 0.01]
    span = float(outside.mean() - inside.mean())
    assert len(near) > 10 and np.abs(near - level).max() < 0.15 * span
    more = np.concatenate([points, points[:3] + 0.2]), np.pad(unit, ((0, 3), (0, 0)))
    np.testing.assert_allclose(spectral_poisson(*more, grid), values, atol=1e-9)
    some, vectors = jnp.asarray(points[:6]), jnp.asarray(unit[:6])
    weights = np.random.default_rng(0).normal(size=grid.shape)

    def scalar(points, vectors, smoothing):
        field = spectral_poisson(points, vectors, grid, smoothing=smoothing)
        return jnp.sum(weights * field)

    at, h = (some, vectors, jnp.asarray(1.2)), 1e-6
    slopes = jax.grad(scalar, argnums=(0, 1, 2))(*at)
    rng = np.random.default_rng(1)
    for k, x in enumerate(at):
        along = rng.normal(size=x.shape)
        moved = lambda s, k=k, a=along, x=x: scalar(*at[:k], x + s * a, *at[k + 1 :])
        expected = (moved(h) - moved(-h)) / (2 * h)
        np.testing.assert_allclose(np.sum(slopes[k] * along), expected, rtol=1e-5)


@pytest.mark.slow
def test_masked_points_are_points_removed():
    scan = np.float32(_scan(300))
    run = lambda cloud: shape_as_points(
        cloud, key=jax.random.key(3), resolutions=(16,), steps=(6,), **SMALL
    )
    grown = np.concatenate([scan, np.full((20, 3), 1e4, np.float32)])
    masked = run(PointCloud(grown, None, np.arange(320) < 300))
    plain = run(scan)
    np.testing.assert_array_equal(masked.mesh.faces, plain.mesh.faces)
    np.testing.assert_allclose(masked.mesh.vertices, plain.mesh.vertices, atol=1e-4)
    np.testing.assert_allclose(masked.losses[0], plain.losses[0], rtol=1e-5)
