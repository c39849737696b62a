"""Padding has no influence and vmap is the loop, for what looks at a posterior."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom.fields import Camera
from jaxgeom.reconstruction import (
    Matern,
    StochasticPoisson,
    calibrate_values,
    next_view,
    solver_posterior,
    tune,
)
from jaxgeom.shapes import Grid, PointCloud

GRID = Grid(jnp.full(3, -1.4), jnp.full(3, 0.2), (15, 15, 15))
KEY = jax.random.key(3)


def _ball(n, seed=0):
    """Points of a ball, and normals that are a little off."""
    rng = np.random.default_rng(seed)
    unit = rng.normal(size=(n, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    normals = unit + 0.15 * rng.normal(size=unit.shape)
    return PointCloud(np.float32(0.7 * unit), np.float32(normals))


def _padded(cloud, more, rubbish):
    """The cloud with masked rows at its end."""
    n = len(cloud.points)
    grow = lambda x: np.concatenate([x, np.full((more, 3), rubbish, np.float32)])
    mask = np.arange(n + more) < n
    return PointCloud(grow(cloud.points), grow(cloud.normals), mask)


def _same(a, b, **tolerance):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, **tolerance)


def _rows(tree):
    count = len(jax.tree.leaves(tree)[0])
    return [jax.tree.map(lambda x, i=i: x[i], tree) for i in range(count)]


def _stacked(*trees):
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


@pytest.mark.slow
def test_solver_posterior():
    run = jax.jit(lambda c: solver_posterior(c, GRID, key=KEY, num=3))
    some = lambda found: (found.samples, found.mean.values, found.result)
    plain = some(run(_ball(60)))
    for rubbish in (7e3, np.nan):
        # Noise of the samples is drawn for padding as well: only these may differ.
        found = run(_padded(_ball(60), 4, rubbish))
        _same(found.mean.values, plain[1], atol=2e-4)
        assert np.isfinite(found.samples).all()
    clouds = [_padded(_ball(60), 4, 7e3), _padded(_ball(50, 1), 14, np.nan)]
    batched = _rows(some(jax.jit(jax.vmap(run))(_stacked(*clouds))))
    for cloud, one in zip(clouds, batched, strict=True):
        _same(one, some(run(cloud)), atol=2e-3)


def _check_held_out(run, numbers, rtol):
    """Of run(cloud, held out): padding and batches change none of the numbers. Gives
    the results of a batch and of each alone."""
    found = run(_padded(_ball(60), 4, np.nan), _padded(_ball(20, 1), 3, 9.0))
    _same(numbers(found), numbers(run(_ball(60), _ball(20, 1))), rtol=rtol)
    clouds = [_padded(_ball(60), 4, 7e3), _padded(_ball(50, 2), 14, 7e3)]
    held = [_padded(_ball(20, 1), 2, 7e3), _padded(_ball(22, 4), 0, 7e3)]
    batched = _rows(jax.jit(jax.vmap(run))(_stacked(*clouds), _stacked(*held)))
    alone = [run(*pair) for pair in zip(clouds, held, strict=True)]
    for one, other in zip(batched, alone, strict=True):
        _same(numbers(one), numbers(other), rtol=rtol)
    return batched, alone


@pytest.mark.slow
def test_tune(x64):
    """In double precision, solved to the end: a search makes small errors large."""
    settings = {"length": 0.5, "num_likely": 12, "max_evaluations": 4, "rtol": 1e-9}
    run = jax.jit(lambda a, b: tune(a, GRID, b, **settings))
    numbers = lambda t: (t.settings.kernel.length, t.settings.noise, t.widening, t.loss)
    batched, alone = _check_held_out(run, numbers, 1e-4)
    for one, other in zip(batched, alone, strict=True):
        assert int(one.steps) == int(other.steps)


@pytest.mark.slow
def test_calibrate_values(x64):
    prior = StochasticPoisson(Matern(0.5))
    run = jax.jit(lambda a, b: calibrate_values(prior, a, GRID, b, num_steps=3))
    numbers = lambda c: (c.settings.value_noise, c.covered, c.result)
    _check_held_out(run, numbers, 1e-6)


@pytest.mark.slow
def test_next_view():
    ball = jnp.linalg.norm(GRID.nodes(), axis=-1) - 0.8
    unsure = jnp.maximum(GRID.nodes()[..., 1], 0) * 0.6
    samples = ball + unsure * jnp.linspace(-1.2, 1.2, 6)[:, None, None, None]
    look = {"length": 4.0, "size": (5, 5), "num_steps": 24, "max_steps": 8}
    run = jax.jit(lambda c: next_view(samples, GRID, c, **look))
    starts = [Camera(jnp.array(x)) for x in ([2.0, -1.5, 0.3], [-1.0, 2.0, 0.5])]
    batched = _rows(jax.jit(jax.vmap(run))(_stacked(*starts)))
    for start, one in zip(starts, batched, strict=True):
        alone = run(start)
        np.testing.assert_allclose(one.score, alone.score, rtol=1e-3)
        np.testing.assert_allclose(
            one.camera.position, alone.camera.position, atol=2e-2
        )
        assert float(one.score) >= float(one.first_score)
