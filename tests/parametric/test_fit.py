"""Fits of NURBS to points: exact recovery, weights, smoothing, correction, statuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import RESULTS
from jaxgeom import parametric as jp

from .members import in_dtype, net

CUBIC = jp.SplineBasis.clamped(8, 3)


def wave(t):
    return jnp.stack([jnp.cos(3 * t), jnp.sin(2 * t**2), t**3], axis=-1)


def test_control_points_are_recovered(x64):
    """From points of the shape itself, with its own rational weights."""
    surface = in_dtype(net(), jnp.float64)
    uv = jnp.asarray(np.random.default_rng(0).uniform((0, -0.5), (1, 1.2), (150, 2)))
    fit = jax.jit(
        lambda s: jp.fit_surface(
            jax.vmap(s)(uv), s.bases, parameters=uv, control_weights=s.weights
        )
    )(surface)
    assert fit.result == RESULTS.successful and fit.rmse < 1e-13
    np.testing.assert_allclose(fit.shape.control, surface.control, atol=1e-11)
    curve = jp.nurbs_arc(0.8, 0.2, 2.9)
    t = jnp.linspace(0, 1, 12)
    again = jax.jit(
        lambda c: jp.fit_curve(
            jax.vmap(c)(t), c.basis, parameters=t, control_weights=c.weights
        )
    )(curve)
    np.testing.assert_allclose(again.shape.control, curve.control, atol=1e-13)


def test_fits_converge_and_follow_their_points(x64):
    """A cubic fit of smooth data is right to the fourth order in the spacing."""
    t = jnp.linspace(0, 1, 400)
    data = wave(t)
    sizes = (8, 13, 23)
    run = lambda n: jp.fit_curve(data, jp.SplineBasis.clamped(n, 3), parameters=t).rmse
    errors = np.array(jax.jit(lambda: [run(n) for n in sizes])())
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (orders > 3.6).all(), orders
    size = lambda d: jp.fit_curve(d, CUBIC, parameters=t).shape.control[3, 1]
    value, slope = jax.jit(jax.value_and_grad(size))(data)
    # Linear in the data: the derivative times the data is the value.
    np.testing.assert_allclose(np.sum(slope * data), value, rtol=1e-10)


def test_points_of_weight_zero_do_not_count(x64):
    t = jnp.linspace(0, 1, 60)
    data = wave(t)
    spoiled = data.at[7].add(5.0)
    weights = jnp.ones(60).at[7].set(0)
    fit = jax.jit(lambda d: jp.fit_curve(d, CUBIC, parameters=t, weights=weights))
    np.testing.assert_allclose(
        fit(spoiled).shape.control, fit(data).shape.control, atol=1e-11
    )


def test_chord_length_and_closed_curves(x64):
    row = jnp.array([[0.0, 0, 0], [0, 3, 0], [4, 3, 0]])
    np.testing.assert_allclose(jp.chord_length(row), [0, 3 / 7, 1])
    np.testing.assert_allclose(jp.chord_length(row, closed=True), [0, 0.25, 7 / 12])
    root = jp.chord_length(row, power=0.5)
    np.testing.assert_allclose(root[1], 3**0.5 / (3**0.5 + 2))
    angle = jnp.linspace(0, 2 * jnp.pi, 80, endpoint=False)
    data = jnp.stack([1.2 * jnp.cos(angle), 0.7 * jnp.sin(angle), 0.1 * angle * 0], 1)
    basis = jp.SplineBasis.closed(10, 3)
    fit = jax.jit(lambda d: jp.fit_curve(d, basis, closed=True))(data)
    assert fit.rmse < 0.01 and fit.shape.closed
    np.testing.assert_array_equal(fit.shape.control[:3], fit.shape.control[-3:])


def test_parameters_of_rows_and_columns():
    x, y = np.meshgrid([0.0, 1, 4], [0.0, 2, 3, 5], indexing="ij")
    found = jax.jit(jp.grid_parameters)(jnp.asarray(np.stack([x, y, 0 * x], -1)))
    np.testing.assert_allclose(found[:, 1, 0], [0, 0.25, 1])
    np.testing.assert_allclose(found[2, :, 1], [0, 0.4, 0.6, 1])


def test_undetermined_control_points_are_reported_and_smoothing_determines_them(x64):
    t = jnp.linspace(0, 0.3, 30)
    data = wave(t)
    run = jax.jit(lambda s: jp.fit_curve(data, CUBIC, parameters=t, smoothing=s))
    bare, smooth = run(0.0), run(1e-9)
    assert bare.result == RESULTS.too_few_points
    assert np.isfinite(bare.shape.control).all()
    assert smooth.result == RESULTS.successful and smooth.rmse < 1e-3
    few = jax.jit(lambda d: jp.fit_curve(d, CUBIC).result)(data[:3])
    assert few == RESULTS.too_few_points
    stiff = run(1e3)
    bends = np.diff(np.asarray(stiff.shape.control), 2, axis=0)
    assert np.abs(bends).max() < 1e-3


REFINE = jax.jit(
    lambda fit, data, steps: jp.refine_fit(fit, data, max_steps=steps),
    static_argnums=2,
)


@pytest.mark.slow
def test_correction_of_parameters_improves_a_curve(x64):
    """Noise-free points of a cubic at unknown parameters: the cubic is found again."""
    basis = jp.SplineBasis.clamped(6, 3)
    true = jp.NurbsCurve(wave(jnp.asarray(basis.greville) ** 2), basis)
    t = jnp.asarray(np.sort(np.random.default_rng(3).uniform(size=40)))
    t = t.at[0].set(0).at[-1].set(1)
    data = jax.vmap(true)(t)
    guess = t + 0.03 * jnp.sin(2 * jnp.pi * t)
    first = jax.jit(lambda d: jp.fit_curve(d, basis, parameters=guess))(data)
    better = REFINE(first, data, 24)
    assert better.result == RESULTS.successful
    assert first.rmse > 1e-2 and better.rmse < 1e-4 * first.rmse
    np.testing.assert_allclose(better.parameters, t, atol=1e-4)
    short = REFINE(first, data, 2)
    assert short.result == RESULTS.not_converged and short.rmse < first.rmse
