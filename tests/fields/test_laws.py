"""Laws that hold for every field of the catalogue."""

import importlib.util
import pathlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import fields as jf

_spec = importlib.util.spec_from_file_location(
    "catalogue", pathlib.Path(__file__).with_name("catalogue.py")
)
catalogue = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(catalogue)

EXACT = sorted(catalogue.exact())
BOUNDS = sorted(catalogue.bounds())
ALL = sorted(catalogue.all_fields())


@jax.jit
def slopes(field, points):
    gradient = jax.vmap(jax.grad(lambda p: field(p)))(points)
    return jnp.linalg.norm(gradient, axis=-1)


@pytest.mark.parametrize("name", EXACT)
def test_exact_distances_have_slope_one(x64, name):
    points = jnp.asarray(catalogue.random_points(500))
    np.testing.assert_allclose(slopes(catalogue.exact()[name], points), 1, rtol=1e-9)


@pytest.mark.parametrize("name", BOUNDS)
def test_bounds_have_slope_at_most_one(x64, name):
    points = jnp.asarray(catalogue.random_points(2000))
    slope = slopes(catalogue.bounds()[name], points)
    assert slope.max() <= 1 + 1e-9 and slope.min() > 0


@pytest.mark.parametrize("name", EXACT)
def test_exact_distance_is_reached_by_one_step_along_the_normal(x64, name):
    field = catalogue.exact()[name]
    points = jnp.asarray(catalogue.random_points(300))
    step = lambda p: p - field(p) * jf.normal(field, p)
    landed = jf.value(field, jax.jit(jax.vmap(step))(points))
    np.testing.assert_allclose(landed, 0, atol=1e-9)


@pytest.mark.parametrize("name", ALL)
def test_gradient_is_the_central_difference(x64, name):
    field = catalogue.all_fields()[name]
    points = jnp.asarray(catalogue.random_points(40, seed=3))
    h = 1e-6

    @jax.jit
    def both(p):
        ends = jnp.concatenate([h * jnp.eye(3), -h * jnp.eye(3)])
        right, left = jnp.split(jax.vmap(lambda e: field(p + e))(ends), 2)
        return jax.grad(lambda x: field(x))(p), (right - left) / (2 * h)

    exact, central = jax.vmap(both)(points)
    np.testing.assert_allclose(exact, central, atol=2e-7)


@pytest.mark.parametrize("name", ALL)
def test_gradients_are_finite_at_singular_points(name):
    field = catalogue.all_fields()[name]
    center = np.array(catalogue.CENTER)
    corner = center + np.array([0.5, 0.3, 0.7])
    edge, axis = corner * [1, 1, 0], center + [0, 0, 0.4]
    ring = center + [0.55, 0, 0]
    points = np.stack([center, corner, edge, axis, ring, np.zeros(3)])
    points = jnp.asarray(points, jnp.float32)
    by_point = jax.vmap(jax.grad(lambda p: field(p)))(points)
    by_field = jax.vmap(eqx.filter_grad(lambda f, p: f(p)), (None, 0))(field, points)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((by_point, by_field)))


@pytest.mark.parametrize("name", ALL)
def test_value_follows_the_dtype_of_the_point(x64, name):
    field = catalogue.all_fields()[name]
    assert field(jnp.ones(3, jnp.float32)).dtype == jnp.float32
    assert field(jnp.ones(3, jnp.float64)).dtype == jnp.float64


@pytest.mark.parametrize("name", ["box", "torus", "cylinder", "capsule", "rounded_box"])
def test_distance_agrees_with_a_sampled_surface(x64, name):
    field = catalogue.exact()[name]
    seeds = jnp.asarray(catalogue.random_points(60_000, seed=5))
    pull = lambda p: p - field(p) * jf.normal(field, p)
    surface = np.asarray(jax.jit(jax.vmap(pull))(seeds))
    points = catalogue.random_points(50, seed=6)
    gaps = np.linalg.norm(points[:, None] - surface[None], axis=-1).min(axis=1)
    distance = np.abs(jf.value(field, jnp.asarray(points)))
    assert (gaps >= distance - 1e-9).all()
    assert (gaps - distance).max() < 0.03


def test_de_morgan_and_difference():
    a, b = catalogue.exact()["torus"], catalogue.exact()["box"]
    points = jnp.asarray(catalogue.random_points(200), jnp.float32)
    at = lambda field: np.asarray(jf.value(field, points))
    np.testing.assert_array_equal(at(~(a | b)), at(~a & ~b))
    np.testing.assert_array_equal(at(~(a & b)), at(~a | ~b))
    np.testing.assert_array_equal(at(a - b), at(a & ~b))
    np.testing.assert_array_equal(at(~~a), at(a))


def test_blend_lies_within_a_sixth_of_its_width_of_the_union():
    a, b = jf.Sphere(0.5, (0.3, 0, 0)), jf.Sphere(0.4, (-0.3, 0.1, 0))
    points = jnp.asarray(catalogue.random_points(4000), jnp.float32)
    gap = jf.value(a | b, points) - jf.value(a.blend(b, 0.3), points)
    assert gap.min() >= -1e-6 and 0.045 < gap.max() <= 0.05 + 1e-6
    apart = np.abs(jf.value(a, points) - jf.value(b, points)) > 0.3
    np.testing.assert_array_equal(np.asarray(gap)[apart], 0)


def test_gradient_reaches_a_radius_through_a_tree():
    field = (jf.Sphere(0.5) | jf.Box((0.2, 0.3, 0.4))).translate((0.3, 0.0, 0.0))
    gradient = jax.grad(lambda f: f(jnp.array([1.2, 0.1, 0.0])))(field)
    assert gradient.body.first.radius == -1


def test_wrong_shapes_are_errors():
    with pytest.raises(ValueError, match="half_extents must have shape"):
        jf.Box((1.0, 2.0))
    with pytest.raises(ValueError, match="scalar parameter"):
        jf.Sphere((1.0, 2.0))
    with pytest.raises(ValueError, match="values must have shape"):
        jf.Sampled(catalogue.sampled().grid, jnp.zeros((3, 3, 3)))
