"""The posterior as two networks, against dense algebra and the posterior on a grid."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.distance import cdist

from jaxgeom import RESULTS, GeometryError, Grid, PointCloud
from jaxgeom._core import name_of
from jaxgeom.learning import Adam
from jaxgeom.pipelines import neural_posterior
from jaxgeom.pipelines._vector_process import Vectors
from jaxgeom.reconstruction import Matern, SquaredExponential, stochastic_poisson

KEY = jax.random.key(5)


def _cap(n, seed=0):
    """Points of the upper part of an ellipsoid, and its normals."""
    x = np.random.default_rng(seed).normal(size=(8 * n, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    x = x[x[:, 2] > -0.2][:n]
    axes = np.array([0.5, 0.4, 0.35])
    normals = x / axes
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(np.float32(x * axes), np.float32(normals))


def _small(cloud, **settings):
    settings = {"adam": Adam(num_steps=20, rate=1e-3), "rank": 4, **settings}
    return neural_posterior(cloud, key=KEY, num_places=300, throw=False, **settings)


@pytest.mark.parametrize("kernel", [Matern(0.3), Matern(0.3, 2.5), Matern(0.3, 0.5)])
def test_kernels_in_closed_form_have_their_spectrum(x64, kernel):
    """The radial Fourier integral of the spectrum is the covariance."""
    r = np.array([0.0, 0.1, 0.4, 1.0])
    k = np.linspace(0, 400, 200_001)
    weight = k**2 * np.asarray(kernel.spectrum(k**2))
    kr = np.where(r[:, None] * k > 0, r[:, None] * k, 1)
    wave = np.where(r[:, None] * k > 0, np.sin(kr) / kr, 1)
    found = np.trapezoid(weight * wave, k, axis=1)
    rtol = 0.05 if kernel.smoothness == 0.5 else 2e-3
    np.testing.assert_allclose(
        kernel.covariance(r**2), found / found[0], rtol=rtol, atol=2e-3
    )


def test_the_vectors_are_those_of_dense_algebra(x64):
    """Padding, and samples without a normal, take no part."""
    cloud = _cap(40)
    normals = np.array(cloud.normals, float)
    normals[3] = 0
    grow = lambda x: np.concatenate([np.array(x, float), np.full((7, 3), 9.0)])
    padded = PointCloud(grow(cloud.points), grow(normals), np.arange(47) < 40)
    places = np.random.default_rng(1).uniform(-0.7, 0.7, (30, 3))
    for kernel in (Matern(0.3), SquaredExponential(0.3)):
        numbers = jnp.asarray(0.4), jnp.asarray(0.15)
        found = eqx.filter_jit(Vectors.of)(
            padded, jnp.asarray(places), kernel, *numbers
        )
        kept = np.arange(40) != 3
        x, n = np.array(cloud.points, float)[kept], normals[kept]
        table = lambda a, b, k=kernel: 0.4 * np.asarray(k.covariance(cdist(a, b) ** 2))
        inner = np.linalg.inv(table(x, x) + 0.15**2 * np.eye(39))
        across = table(places, x)
        np.testing.assert_allclose(found.mean, across @ inner @ n, atol=1e-7)
        known = table(places, places) - across @ inner @ across.T
        rows = jnp.arange(30)
        np.testing.assert_allclose(found.covariance(rows, rows), known, atol=1e-7)


@pytest.mark.slow
def test_draws_have_the_covariance_and_the_samples_are_the_anchor():
    cloud = _cap(60)
    found = _small(cloud)
    points = jnp.asarray(cloud.points)
    factor = found.factor(points)
    np.testing.assert_allclose(jnp.mean(factor, axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(jnp.mean(jax.vmap(found)(points)), 0, atol=1e-5)
    np.testing.assert_allclose(found.std(points), jnp.linalg.norm(factor, axis=1), 1e-5)
    at = points[:3] * 1.2
    draw = lambda key: jax.vmap(found.draw(key))(at)
    drawn = jax.jit(jax.vmap(draw))(jax.random.split(KEY, 20_000))
    rows = found.factor(at)
    np.testing.assert_allclose(
        jnp.cov(drawn.T), rows @ rows.T, atol=0.05 * float(jnp.max(rows @ rows.T))
    )
    np.testing.assert_allclose(
        jnp.mean(drawn, axis=0), jax.vmap(found)(at), atol=0.05 * float(jnp.std(drawn))
    )
    inside = jnp.mean(drawn < 0, axis=0)
    np.testing.assert_allclose(found.probability_inside(at), inside, atol=0.02)
    again = _small(cloud)
    assert jax.tree.all(jax.tree.map(np.array_equal, found, again))


@pytest.mark.slow
def test_unit_place_and_padding():
    """A scan in another unit and place gives the same distribution there."""
    cloud = _cap(60)
    settings = {"kernel": Matern(0.2)}
    found = _small(cloud, **settings)
    points = np.float64(cloud.points) * 200 + np.array([50.0, -30.0, 10.0])
    moved = PointCloud(points, np.float64(cloud.normals))
    other = _small(moved, kernel=Matern(40.0))
    at = np.float32(cloud.points[:8] * 1.3)
    there = np.float32(at * 200.0 + np.array([50.0, -30.0, 10.0]))
    np.testing.assert_allclose(other.std(there), 200 * found.std(at), rtol=0.02)
    grow = lambda x: np.concatenate([x, np.full((9, 3), np.nan, np.float32)])
    masked = PointCloud(grow(cloud.points), grow(cloud.normals), np.arange(69) < 60)
    again = _small(masked, **settings)
    np.testing.assert_allclose(again.std(at), found.std(at), rtol=1e-4)


@pytest.mark.slow
def test_errors_and_statuses():
    cloud = _cap(60)
    assert name_of(_small(cloud).result) == "not_converged"
    with pytest.raises(GeometryError, match="with normals"):
        neural_posterior(PointCloud(cloud.points), key=KEY)
    many = jax.tree.map(lambda x: np.repeat(x, 200, axis=0), cloud)
    with pytest.raises(GeometryError, match="at most 8192 points"):
        neural_posterior(many, key=KEY)
    with pytest.raises(GeometryError, match="smoothness of 0.5, 1.5 or 2.5"):
        _small(cloud, kernel=Matern(0.2, 2.0))
    wild = Adam(num_steps=20, rate=1e3)
    with pytest.raises(GeometryError, match="finite loss"):
        neural_posterior(cloud, key=KEY, rank=4, num_places=300, adam=wild)


@pytest.mark.slow
def test_it_agrees_with_the_posterior_on_a_grid():
    cloud = _cap(150)
    kernel = Matern(0.25)
    found = neural_posterior(cloud, key=KEY, kernel=kernel, screening=0.01)
    assert found.result == RESULTS.successful and float(found.explained) > 0.3
    grid = Grid(jnp.full(3, -1.2), jnp.full(3, 0.06), (40, 40, 40))
    known = jax.jit(lambda c: stochastic_poisson(c, grid, kernel=kernel))(cloud)
    points = np.random.default_rng(2).uniform(-0.55, 0.55, (80, 3))
    points = jnp.asarray(np.float32(points))
    std, true = np.asarray(found.std(points)), np.asarray(known.std(points))
    assert np.corrcoef(std, true)[0, 1] > 0.93
    assert 0.8 < np.median(std / true) < 1.15
    mean = np.asarray(jax.vmap(found)(points))
    apart = (mean - np.asarray(jax.vmap(known)(points))) / true
    assert np.sqrt(np.mean(apart**2)) < 0.6
    chance = found.probability_inside(points) - known.probability_inside(points)
    assert np.abs(chance).mean() < 0.12
