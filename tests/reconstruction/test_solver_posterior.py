"""The distribution that the energy of screened Poisson leaves open."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import RESULTS
from jaxgeom._core import GeometryError
from jaxgeom.linear import interpolate, laplacian, splat
from jaxgeom.reconstruction import (
    Dirichlet,
    ScreenedPoisson,
    screened_poisson,
    solver_posterior,
)
from jaxgeom.reconstruction._poisson import system_of
from jaxgeom.reconstruction._solver_posterior import coloured
from jaxgeom.shapes import Grid, PointCloud

SHAPE = (5, 6, 4)


def _ball(n, half=False, dtype=np.float64):
    unit = np.random.default_rng(0).normal(size=(n, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    unit = unit[unit[:, 1] > 0] if half else unit
    return PointCloud(jnp.asarray(0.7 * unit, dtype), jnp.asarray(unit, dtype))


def _grid(n, dtype=np.float64):
    return Grid(jnp.full(3, -1.5, dtype), jnp.full(3, 3 / (n - 1), dtype), (n,) * 3)


def _dense(function, shapes):
    """The matrix of a linear function of arrays of given shapes."""
    sizes = [int(np.prod(shape)) for shape in shapes]
    rows = jnp.eye(sum(sizes))

    def flat(x):
        parts = jnp.split(x, np.cumsum(sizes)[:-1])
        return function(
            *(p.reshape(s) for p, s in zip(parts, shapes, strict=True))
        ).ravel()

    return np.asarray(jax.vmap(flat, out_axes=1)(rows))


def test_the_noise_has_the_covariance_of_the_system(x64):
    spacing = jnp.array([0.5, 0.4, 0.6])
    grid = Grid(-spacing * (jnp.array(SHAPE) - 1) / 2, spacing, SHAPE)
    cloud = _ball(9)
    method = ScreenedPoisson(screening=3.0)
    system = system_of(cloud, grid, method, jnp.asarray(3.0), None, None)
    assert float(jnp.max(system.pull)) > 0
    apply = lambda u: (
        laplacian(u, system.coefficients)
        + splat(system.pull * interpolate(u, system.seen.q), system.seen.q, SHAPE)
    )
    a = _dense(apply, [SHAPE])
    edges = [tuple(n - (d == e) for e, n in enumerate(SHAPE)) for d in range(3)]
    m = _dense(lambda x, y, z, p: coloured([x, y, z], p, system), [*edges, (9,)])
    np.testing.assert_allclose(m @ m.T, a, atol=1e-10)
    found = solver_posterior(
        cloud,
        grid,
        key=jax.random.key(0),
        num=4000,
        method=ScreenedPoisson(screening=3.0, rtol=1e-8, max_steps=200),
        temperature=0.3,
    )
    rows = np.asarray(found.samples).reshape(4000, -1)
    covariance = 0.3 * np.linalg.inv(a)
    mean = np.asarray(found.mean.values - found.mean.level).ravel()
    spread = np.sqrt(np.diag(covariance))
    assert np.abs(rows.mean(axis=0) - mean).max() < 5 * spread.max() / np.sqrt(4000)
    error = np.abs(np.cov(rows.T) - covariance) / np.outer(spread, spread)
    assert error.max() < 7 / np.sqrt(4000)


@pytest.mark.slow
def test_what_was_not_scanned_is_unsure():
    cloud, grid = _ball(800, half=True, dtype=np.float32), _grid(16, np.float32)
    found = jax.jit(lambda c: solver_posterior(c, grid, key=jax.random.key(1), num=24))(
        cloud
    )
    assert found.result == RESULTS.successful and float(found.temperature) > 0
    alone = screened_poisson(cloud, grid, rtol=1e-3, max_steps=100)
    np.testing.assert_allclose(found.mean.values, alone.values, atol=1e-4)
    seen, other = (jnp.array([[0.0, s * 0.7, 0.0]]) for s in (1.0, -1.0))
    assert float(found.std(other)[0]) > 3 * float(found.std(seen)[0])
    hot = solver_posterior(
        cloud, grid, key=jax.random.key(1), num=24, temperature=4 * found.temperature
    )
    np.testing.assert_allclose(hot.std(other), 2 * found.std(other), rtol=0.05)
    with pytest.raises(GeometryError, match="positive"):
        method = ScreenedPoisson(screening=0)
        solver_posterior(cloud, grid, key=jax.random.key(1), method=method)
    with pytest.raises(GeometryError, match="Neumann"):
        method = ScreenedPoisson(boundary=Dirichlet())
        solver_posterior(cloud, grid, key=jax.random.key(1), method=method)
