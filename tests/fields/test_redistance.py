"""Redistancing: the surface stays, the values become distances."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import fields as jf
from jaxgeom._core import RESULTS
from jaxgeom.shapes import Grid

redistance = jax.jit(jf.redistance)


def grid_of(number):
    step = 2.4 / (number - 1)
    return Grid(jnp.array([-1.2, -1.17, -1.22]), jnp.full(3, step), (number,) * 3)


def uneven(p):
    """A factor between 0.3 and 3, which makes of a distance something else."""
    return 1.65 + 1.35 * jnp.sin(3 * p[0] + 2 * p[1]) * jnp.cos(2 * p[2])


def errors(body, number):
    grid = grid_of(number)
    values = jf.sample(lambda p: body(p) * uneven(p), grid)
    found = redistance(grid, values)
    assert found.result == RESULTS.successful
    np.testing.assert_array_equal(jnp.sign(found.values), jnp.sign(values))
    return np.abs(found.values - jf.sample(body, grid))


@pytest.mark.slow
def test_second_order_on_a_sphere(x64):
    body = jf.Sphere(0.7)
    coarse, fine = errors(body, 17), errors(body, 33)
    orders = np.log2([coarse.mean() / fine.mean(), coarse.max() / fine.max()])
    assert orders[0] > 1.7 and orders[1] > 1.2
    assert fine.mean() < 0.04 * 2.4 / 32 and fine.max() < 0.2 * 2.4 / 32


@pytest.mark.slow
def test_a_box_loses_its_edges_only(x64):
    body = jf.Box((0.6, 0.5, 0.45))
    coarse, fine = errors(body, 17), errors(body, 33)
    orders = np.log2([coarse.mean() / fine.mean(), coarse.max() / fine.max()])
    assert orders[0] > 0.8 and fine.max() < 2.4 / 32


def test_derivatives_are_those_of_the_surface(x64):
    grid = grid_of(17)
    values = jf.sample(lambda p: jf.Sphere(0.7)(p) * uneven(p), grid)
    distances = lambda v: redistance(grid, v).values
    _, scaled = jax.jvp(distances, (values,), (values,))
    np.testing.assert_allclose(scaled, 0, atol=1e-3)
    plain = jf.sample(jf.Sphere(0.7), grid)
    _, grown = jax.jvp(distances, (plain,), (-jnp.ones_like(plain),))
    h = 1e-4
    central = (distances(plain - h) - distances(plain + h)) / (2 * h)
    assert np.median(np.abs(grown - central)) < 1e-3
    np.testing.assert_allclose(np.median(grown), -1, atol=0.01)


def test_no_surface_and_too_few_steps():
    grid = grid_of(17)
    found = redistance(grid, jnp.ones(grid.shape))
    assert found.result == RESULTS.no_surface and np.isfinite(found.values).all()
    values = jf.sample(jf.Sphere(0.7), grid)
    few = jax.jit(lambda v: jf.redistance(grid, v, max_steps=1))(values)
    assert few.result == RESULTS.not_converged
