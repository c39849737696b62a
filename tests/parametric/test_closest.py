"""Nearest points: exact answers, ends, seams, poles, derivatives, statuses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxgeom import RESULTS, GeometryError
from jaxgeom import parametric as jp

from .members import in_dtype, net

NUMBER = 200


@eqx.filter_jit
def nearest(shape, queries, **settings):
    return jax.vmap(lambda q: jp.closest_point(shape, q, **settings))(queries)


def queries(seed=0, dtype=jnp.float64):
    return jnp.asarray(np.random.default_rng(seed).normal(size=(NUMBER, 3)), dtype)


def succeeded(found):
    return np.asarray(found.result == RESULTS.successful)


def ellipsoid_distance(radii, q):
    """By bisection of sum (a q / (t + a^2))^2 = 1 for t > -min a^2 (Eberly 2013)."""
    low = -(np.min(radii) ** 2) + np.min(radii) * np.abs(q[:, np.argmin(radii)])
    high = -(np.min(radii) ** 2) + np.linalg.norm(radii * q, axis=1)
    for _ in range(200):
        t = (low + high) / 2
        value = np.sum((radii * q / (t[:, None] + radii**2)) ** 2, axis=1) - 1
        low, high = np.where(value > 0, t, low), np.where(value > 0, high, t)
    return np.linalg.norm(q - radii**2 * q / (t[:, None] + radii**2), axis=1)


def check_parallel(shape, found, q, slack):
    """The difference has no part along the tangents."""
    tangents = jax.jit(jax.vmap(lambda x: jp.tangents(shape, x)))(found.parameters)
    along = np.einsum("nid,nd->ni", tangents, q - found.point)
    assert np.abs(along / np.linalg.norm(tangents, axis=2)).max() < slack


def least_of_samples(shape, places, q):
    dense = np.asarray(jax.jit(jax.vmap(shape))(jnp.asarray(places)))
    return np.array([np.linalg.norm(dense - p, axis=1).min() for p in np.asarray(q)])


def torus_distance(q):
    x, y, z = np.asarray(q).T
    return np.abs(np.hypot(np.hypot(x, y) - 1.3, z) - 0.4)


def test_tori(x64):
    torus, q = jp.Torus(1.3, 0.4), queries()
    found = nearest(torus, q)
    assert succeeded(found).all()
    np.testing.assert_allclose(found.distance, torus_distance(q), atol=1e-14)
    check_parallel(torus, found, q, 1e-12)
    one = jax.jit(lambda p: jp.closest_point(torus, p))
    for k in range(3):
        single = one(q[k])
        np.testing.assert_allclose(single.parameters, found.parameters[k], atol=1e-12)
        assert succeeded(single) == succeeded(found)[k]


@pytest.mark.slow
def test_tori_of_nurbs(x64):
    torus, q = jp.nurbs_torus(1.3, 0.4), queries()
    found = nearest(torus, q)
    assert succeeded(found).all()
    np.testing.assert_allclose(found.distance, torus_distance(q), atol=1e-14)
    check_parallel(torus, found, q, 1e-12)


@pytest.mark.parametrize(
    "dtype", [jnp.float32, pytest.param(jnp.float64, marks=pytest.mark.slow)]
)
def test_ellipsoids(dtype):
    with jax.enable_x64(True):
        shape = in_dtype(jp.Ellipsoid((0.7, 0.4, 0.5)), dtype)
        q = queries(1, dtype)
        found = nearest(shape, q)
        expected = ellipsoid_distance(np.array([0.7, 0.4, 0.5]), np.float64(q))
        eps = jnp.finfo(dtype).eps
        assert found.distance.dtype == dtype and succeeded(found).all()
        np.testing.assert_allclose(found.distance, expected, atol=64 * eps)
        check_parallel(shape, found, q, 128 * eps)


def test_spheres_and_their_poles(x64):
    """On the axis, beyond a pole and in the middle, where all points are as near."""
    sphere = jp.Sphere(0.7, (0.1, -0.2, 0.3))
    special = np.array([[0, 0, 1.4], [0, 0, -0.3], [0, 0, 0], [1e-3, -1e-3, 0.7]])
    q = queries().at[:4].set(sphere.center + special)
    found = nearest(sphere, q)
    expected = np.abs(np.linalg.norm(q - sphere.center, axis=1) - 0.7)
    assert succeeded(found).all()
    np.testing.assert_allclose(found.distance, expected, atol=1e-14)


def test_ends_are_kept_and_seams_are_passed(x64):
    side = jp.Cylinder(0.6, 1.0)
    q = queries()
    found = nearest(side, q)
    x, y, z = np.asarray(q).T
    above = np.maximum(np.abs(z) - 0.5, 0)
    expected = np.hypot(np.hypot(x, y) - 0.6, above)
    assert succeeded(found).all() and (above > 0).sum() > 20
    np.testing.assert_allclose(found.distance, expected, atol=1e-14)
    u, v = np.asarray(found.parameters).T
    assert (
        (0 <= v).all() and (v <= 1).all() and (0 <= u).all() and (u <= 2 * np.pi).all()
    )


@pytest.mark.slow
def test_a_free_patch_against_dense_samples(x64):
    surface = in_dtype(net(crease=False), jnp.float64)
    q = jnp.array([0.6, 0.4, 0.0]) + 0.4 * queries()
    found = nearest(surface, q)
    grid = np.stack(
        np.meshgrid(np.linspace(0, 1, 201), np.linspace(-0.5, 1.2, 201)), -1
    )
    dense = np.asarray(jax.jit(jax.vmap(surface))(jnp.asarray(grid.reshape(-1, 2))))
    least = np.array([np.linalg.norm(dense - p, axis=1).min() for p in np.asarray(q)])
    assert succeeded(found).all()
    gap = np.asarray(found.distance) - least
    assert gap.max() < 1e-12 and gap.min() > -0.01


def test_curves(x64):
    q = queries()
    for shape in (jp.TorusKnot(1.2, 0.4), jp.Polyline(np.asarray(queries(9)[:5]))):
        span = shape.interval()
        found = nearest(shape, q)
        dense = np.asarray(
            jax.jit(jax.vmap(shape))(jnp.linspace(span.low, span.high, 4001))
        )
        least = np.array(
            [np.linalg.norm(dense - p, axis=1).min() for p in np.asarray(q)]
        )
        gap = np.asarray(found.distance) - least
        assert gap.max() < 1e-12 and gap.min() > -0.01


class Waves(eqx.Module):
    """(u, v, a sin(2 u + b) cos v): its parameters are leaves."""

    height: jax.Array
    phase: jax.Array

    def __call__(self, uv):
        u, v = uv
        wave = self.height * jnp.sin(2 * u + self.phase) * jnp.cos(v)
        return jnp.stack([u, v, wave])


@pytest.mark.slow
def test_derivatives(x64):
    """Against central differences, inside the domain, at an end and at a corner."""
    places = jnp.array([[0.7, 0.4, 0.5], [0.5, -0.4, 0.3], [-0.4, -0.5, 0.2]])
    over = jp.Domain(jp.Interval(0, 1.2), jp.Interval(0.1, 0.9))

    def outcome(shift, place):
        waves = Waves(0.3 + shift[3], 0.4 + shift[4])
        shape = jp.FunctionSurface(waves, over)
        found = jp.closest_point(shape, place + shift[:3], starts=(8, 8), num_starts=1)
        return jnp.concatenate([found.parameters, found.point, found.distance[None]])

    h = 1e-6
    shifts = jnp.concatenate([h * jnp.eye(5), -h * jnp.eye(5), jnp.zeros((1, 5))])

    @jax.jit
    @jax.vmap
    def all_of(place):
        forward = jax.jacfwd(lambda s: outcome(s, place))(jnp.zeros(5))
        backward = jax.jacrev(lambda s: outcome(s, place))(jnp.zeros(5))
        return forward, backward, jax.vmap(lambda s: outcome(s, place))(shifts)

    forward, backward, values = all_of(places)
    differences = (values[:, :5] - values[:, 5:10]).swapaxes(1, 2) / (2 * h)
    np.testing.assert_allclose(forward, backward, atol=1e-10)
    np.testing.assert_allclose(forward, differences, atol=1e-7)
    at = values[:, 10]
    inside = (at[:, :2] > jnp.array([0, 0.1])).sum(axis=1)
    np.testing.assert_array_equal(inside, [2, 1, 0])
    unit = (places - at[:, 2:5]) / at[:, 5:]
    np.testing.assert_allclose(forward[:, 5, :3], unit, atol=1e-12)


@pytest.mark.slow
def test_a_search_cut_short_says_so(x64):
    shape, q = jp.Ellipsoid((0.7, 0.2, 0.5)), queries()
    short = nearest(shape, q, max_steps=1, starts=(4, 3), num_starts=1)
    exact = ellipsoid_distance(np.array([0.7, 0.2, 0.5]), np.asarray(q))
    assert succeeded(short).mean() < 0.2
    assert (short.distance >= exact - 1e-12).all()
    right = np.abs(short.distance - exact) < 1e-14
    assert right[succeeded(short)].all()


@pytest.mark.slow
def test_other_solvers_of_optimistix(x64):
    torus, q = jp.Torus(1.3, 0.4), queries()[:20]
    solver = optx.LevenbergMarquardt(rtol=1e-9, atol=1e-9)
    found = nearest(torus, q, solver=solver, max_steps=128)
    np.testing.assert_allclose(found.distance, torus_distance(q), atol=1e-12)


def test_bad_queries_are_refused():
    with pytest.raises(GeometryError, match="query must have shape"):
        jp.closest_point(jp.Sphere(0.7), jnp.zeros(2))
