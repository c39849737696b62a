"""Volume and area of bodies, their order and their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import fields as jf
from jaxgeom.shapes import Grid


def grid_of(number, shift=0.0):
    step = 2.4 / (number - 1)
    origin = jnp.array([-1.2, -1.17, -1.22]) + shift * step
    return Grid(origin, step * jnp.array([1.0, 0.98, 1.02]), (number,) * 3)


@functools.partial(jax.jit, static_argnums=0)
def both(field, grid):
    return jf.volume(field, grid), jf.area(field, grid)


RADII = np.array([0.9, 0.6, 0.7])


def quadric(p):
    return jnp.sum((p / RADII) ** 2) - 1


def test_second_order_on_an_ellipsoid(x64):
    # The area of an ellipsoid, by quadrature on the sphere.
    z, w = np.polynomial.legendre.leggauss(200)
    u = np.arange(400) * 2 * np.pi / 400
    r = np.sqrt(1 - z**2)
    n = np.stack([np.outer(r, np.cos(u)), np.outer(r, np.sin(u)), z[:, None] + 0 * u])
    stretch = np.sqrt(np.sum((n / RADII[:, None, None]) ** 2, axis=0))
    exact = np.array(
        [4 * np.pi / 3, np.sum(w[:, None] * stretch) * 2 * np.pi / 400]
    ) * np.prod(RADII)
    errors = []
    for number in (17, 33):
        shifts = np.random.default_rng(0).uniform(-0.5, 0.5, 4)
        found = [both(quadric, grid_of(number, s)) for s in shifts]
        errors.append(np.abs(np.array(found) - exact).mean(axis=0) / exact)
    orders = np.log2(errors[0] / errors[1])
    assert (errors[1] < 0.01).all() and (orders > 1.7).all(), (errors, orders)


def test_exact_where_the_field_is_linear(x64):
    normal = jnp.array([0.3, -0.5, 0.8])
    volume, area = both(lambda p: jnp.dot(p, normal) - 10, grid_of(17))
    size = grid_of(17).spacing * 16
    np.testing.assert_allclose([volume, area], [jnp.prod(size), 0], rtol=1e-12)
    half = lambda p: p[2] - 0.1
    volume, area = both(half, grid_of(17))
    np.testing.assert_allclose(area, size[0] * size[1], rtol=1e-12)
    np.testing.assert_allclose(volume, size[0] * size[1] * 1.32, rtol=1e-12)
    tilted = lambda p: p[0] + 0.5 * p[1] + 0.01
    middle = -0.01 - 0.5 * (-1.17 + size[1] / 2) + 1.2
    volume, area = both(tilted, grid_of(17))
    np.testing.assert_allclose(volume, middle * size[1] * size[2], rtol=1e-12)
    np.testing.assert_allclose(area, size[1] * size[2] * np.sqrt(1.25), rtol=1e-12)


def test_the_volume_of_a_ball_grows_by_its_area(x64):
    radius, h = jnp.asarray(0.8), 1e-5
    grid = grid_of(33)
    volume = lambda r: jf.volume(lambda p: jf.Sphere(r)(p), grid)
    area = lambda r: jf.area(lambda p: jf.Sphere(r)(p), grid)

    @jax.jit
    def all_of(r):
        slopes = [jax.grad(f)(r) for f in (volume, area)]
        central = [(f(r + h) - f(r - h)) / (2 * h) for f in (volume, area)]
        return slopes, central

    slopes, central = all_of(radius)
    np.testing.assert_allclose(slopes, central, rtol=1e-6)
    exact = 4 * np.pi * 0.64
    np.testing.assert_allclose(slopes[0], exact, rtol=0.005)
    np.testing.assert_allclose(slopes[1], 8 * np.pi * 0.8, rtol=0.01)


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_flat_fields_have_finite_derivatives(level):
    grid = grid_of(17)
    total = lambda c: (
        jf.volume(lambda p: c + 0 * p[0], grid) + jf.area(lambda p: c + 0 * p[0], grid)
    )
    value, slope = jax.value_and_grad(total)(level)
    assert value == 0 and np.isfinite(slope)
