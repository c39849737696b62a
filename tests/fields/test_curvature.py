"""Gradients, Hessians, curvatures and the inside test against closed formulas."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import fields as jf

NUMBER = 24


def directions(seed):
    v = np.random.default_rng(seed).normal(size=(NUMBER, 3))
    return jnp.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def bends(field, points):
    return jax.jit(jax.vmap(lambda p: jf.curvatures(field, p)))(points)


def test_level_sets_of_a_sphere(x64):
    points = directions(0) * jnp.linspace(0.2, 2, NUMBER)[:, None]
    found = bends(lambda p: jnp.exp(jf.Sphere(0.7)(p)), points)
    r = jnp.linalg.norm(points, axis=1)
    np.testing.assert_allclose(found.mean, 1 / r, rtol=1e-12)
    np.testing.assert_allclose(found.gaussian, 1 / r**2, rtol=1e-12)
    np.testing.assert_allclose(found.principal, jnp.stack([1 / r] * 2, 1), rtol=1e-7)


def test_a_torus(x64):
    big, small = 0.6, 0.25
    u, v = np.random.default_rng(1).uniform(0, 2 * np.pi, (2, NUMBER))
    ring = big + small * np.cos(v)
    points = np.stack([ring * np.cos(u), ring * np.sin(u), small * np.sin(v)], axis=1)
    found = bends(jf.Torus(big, small), jnp.asarray(points))
    around, along = np.full(NUMBER, 1 / small), np.cos(v) / ring
    np.testing.assert_allclose(
        found.principal, np.stack([around, along], axis=1), atol=1e-9
    )
    np.testing.assert_allclose(found.mean, (around + along) / 2, atol=1e-9)
    np.testing.assert_allclose(found.gaussian, around * along, atol=1e-9)


def test_an_ellipsoid_whose_values_are_no_distances(x64):
    radii = jnp.array([0.7, 0.4, 0.5])
    points = directions(2) * radii
    found = bends(lambda p: jnp.sum((p / radii) ** 2) - 1, points)
    lever = jnp.sum(points**2 / radii**4, axis=1)
    gaussian = 1 / (jnp.prod(radii) * lever) ** 2
    square = jnp.sum(radii**2) - jnp.sum(points**2, axis=1)
    mean = square / (2 * jnp.prod(radii) ** 2 * lever**1.5)
    np.testing.assert_allclose(found.gaussian, gaussian, rtol=1e-10)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-10)
    np.testing.assert_allclose(jnp.sum(found.principal, axis=1), 2 * mean, rtol=1e-10)
    np.testing.assert_allclose(jnp.prod(found.principal, axis=1), gaussian, rtol=1e-10)
    assert (bends(lambda p: 1 - jnp.sum((p / radii) ** 2), points).mean < 0).all()


def test_derivatives_are_central_differences(x64):
    field = jf.Ellipsoid((0.7, 0.4, 0.5)).blend(jf.Sphere(0.3, (0.4, 0.3, 0.2)), 0.2)
    point, h = jnp.array([0.3, 0.35, 0.25]), 1e-5

    @jax.jit
    def both(p):
        steps = h * jnp.eye(3)
        slope = lambda x: jf.gradient(field, x)
        rows = lambda f: jnp.stack([(f(p + e) - f(p - e)) / (2 * h) for e in steps])
        return rows(field), slope(p), rows(slope), jf.hessian(field, p)

    first, slope, second, matrix = both(point)
    np.testing.assert_allclose(slope, first, atol=1e-8)
    np.testing.assert_allclose(matrix, second, atol=1e-7)


def test_all_is_finite_at_singular_points():
    bodies = [(jf.Sphere(0.5), (0, 0, 0)), (jf.Torus(0.6, 0.25), (0.6, 0, 0))]
    bodies += [(jf.Box((0.5, 0.4, 0.3)), (0.5, 0.4, 0.3))]
    for field, place in bodies:
        point = jnp.asarray(place, jnp.float32)
        found = jf.curvatures(field, point)
        slope, matrix = jf.gradient(field, point), jf.hessian(field, point)
        for leaf in jax.tree.leaves((found, slope, matrix)):
            assert np.isfinite(leaf).all(), field
    assert jf.curvatures(jf.Sphere(0.5), jnp.zeros(3)).mean == 0


def test_inside_is_the_open_body():
    points = jnp.array([[[0.0, 0, 0], [0.5, 0, 0]], [[0.6, 0, 0], [0, -0.4, 0]]])
    np.testing.assert_array_equal(
        jf.inside(jf.Sphere(0.5), points), [[True, False], [False, True]]
    )
