"""Generalized Procrustes: gauge, optimum, missing points, statuses, derivatives."""

from operator import itemgetter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.transforms import Similarity, generalized_procrustes

K, N = 6, 12
solve = jax.jit(
    lambda x, m, scaling: generalized_procrustes(x, m, scaling=scaling),
    static_argnums=2,
)


def _shapes(noise=0.05, scale=True):
    rng = np.random.default_rng(2)
    base = rng.normal(size=(N, 3)) * [3, 2, 1] + [4, 0, -2]
    turns = Rotation.random(K, random_state=1).as_matrix()
    sizes = rng.uniform(0.5, 2, (K, 1, 1)) if scale else 1
    shapes = sizes * np.einsum("kij,nj->kni", turns, base)
    shapes = shapes + noise * rng.normal(size=shapes.shape)
    missing = rng.uniform(size=(K, N)) < 0.25
    return shapes + rng.normal(size=(K, 1, 3)), ~missing, base


@pytest.mark.parametrize("scaling", [False, True])
def test_exact_copies_coincide(scaling, x64):
    shapes, mask, base = _shapes(0, scaling)
    fit = solve(np.where(mask[..., None], shapes, np.nan), mask, scaling)
    assert fit.result == RESULTS.successful
    assert fit.rmse < 1e-11
    moved = jax.vmap(lambda t, x: t(x))(fit.transforms, shapes)
    np.testing.assert_allclose(moved, np.broadcast_to(fit.mean, (K, N, 3)), atol=1e-10)
    distances = lambda x: np.linalg.norm(x[:, None] - x, axis=-1)
    ratio = distances(np.asarray(fit.mean))[0, 1:] / distances(base)[0, 1:]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-10)
    if not scaling:
        np.testing.assert_allclose(ratio, 1, rtol=1e-10)


@pytest.mark.parametrize("scaling", [False, True])
def test_gauge(scaling, x64):
    shapes, mask, _ = _shapes()
    fit = solve(shapes, mask, scaling)
    np.testing.assert_allclose(np.mean(fit.mean, axis=0), 0, atol=1e-14)
    np.testing.assert_allclose(fit.transforms.rotation[0], np.eye(3), atol=1e-9)
    if scaling:
        np.testing.assert_allclose(np.mean(np.sum(fit.mean**2, 1)), 1, rtol=1e-13)
    assert 1 < fit.steps < 200


@pytest.mark.parametrize("scaling", [False, True])
def test_optimum_is_stationary(scaling, x64):
    shapes, mask, _ = _shapes(0.3)
    fit = solve(shapes, mask, scaling)
    linear = jax.vmap(lambda t: t.linear())(fit.transforms)
    moved = jnp.einsum("kij,knj->kni", linear, shapes)
    moved = moved + fit.transforms.translation[:, None]

    @jax.jit
    def slope(mean, steps):
        def cost(mean, steps):
            steps = steps if scaling else steps.at[:, 6].set(0)
            turned = jax.vmap(lambda s, x: Similarity.exp(s)(x))(steps, moved)
            gaps = jnp.where(mask[..., None], turned - mean, 0)
            weight = jnp.sum(mask, axis=0)[:, None]
            center = jnp.sum(weight * mean, axis=0) / jnp.sum(weight)
            size = jnp.sum(weight * (mean - center) ** 2)
            # Shrinking everything is no fit: the sum is relative to the mean's size.
            return jnp.sum(gaps**2) / (size if scaling else 1)

        return jax.grad(cost, argnums=(0, 1))(mean, steps)

    for gradient in slope(fit.mean, jnp.zeros((K, 7))):
        np.testing.assert_allclose(gradient, 0, atol=1e-9)


def test_rmse_is_that_of_the_aligned_shapes():
    shapes, mask, _ = _shapes()
    fit = solve(shapes.astype(np.float32), mask, False)
    moved = jax.vmap(lambda t, x: t(x))(fit.transforms, shapes)
    gaps = np.sum((np.asarray(moved) - fit.mean) ** 2, axis=-1)
    np.testing.assert_allclose(fit.rmse, np.sqrt(gaps[mask].mean()), rtol=1e-5)
    assert fit.mean.dtype == np.float32 and fit.result == RESULTS.successful


def test_missing_points_and_padding_do_not_matter(x64):
    shapes, mask, _ = _shapes()
    expected = solve(shapes, mask, True)
    for fill in (1e9, np.nan):
        fit = solve(np.where(mask[..., None], shapes, fill), mask, True)
        np.testing.assert_allclose(fit.mean, expected.mean, atol=1e-12)
    grown = np.concatenate([shapes, np.full((K, 3, 3), 7.0)], axis=1)
    absent = np.concatenate([mask, np.zeros((K, 3), bool)], axis=1)
    fit = generalized_procrustes(grown, absent, scaling=True)
    np.testing.assert_allclose(fit.mean[:N], expected.mean, atol=1e-12)
    assert not np.any(fit.mean[N:])


@pytest.mark.slow
def test_hopeless_shape_has_no_say(x64):
    shapes, mask, _ = _shapes(scale=False)
    expected = generalized_procrustes(shapes[1:], mask[1:])
    assert expected.result == RESULTS.successful
    lost = mask.copy()
    lost[0, 2:] = False
    fit = solve(shapes, lost, False)
    assert fit.result == RESULTS.too_few_points
    np.testing.assert_allclose(fit.rmse, expected.rmse, rtol=1e-8)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(fit.transforms))
    flat = shapes.copy()
    flat[3] = flat[3, :1] + np.linspace(0, 1, N)[:, None] * [1.0, 2, 3]
    assert solve(flat, mask, False).result == RESULTS.degenerate_input
    short = generalized_procrustes(shapes, mask, scaling=True, max_steps=2)
    assert short.result == RESULTS.not_converged and short.steps == 2


@pytest.mark.slow
def test_derivative_of_the_fixed_point(x64):
    shapes, mask, _ = _shapes(0.3)
    shapes, mask = jnp.asarray(shapes[:4]), jnp.asarray(mask[:4])
    probe = jnp.cos(jnp.arange(N * 3.0)).reshape(N, 3)

    def loss(x):
        fit = generalized_procrustes(x, mask, scaling=True)
        return jnp.sum(probe * fit.mean) + fit.rmse + jnp.sum(fit.transforms.scale**2)

    @jax.jit
    def both(x):
        step = 1e-5 * jnp.eye(x.size).reshape(-1, *x.shape)[::5]
        central = jax.lax.map(lambda e: (loss(x + e) - loss(x - e)) / 2e-5, step)
        forward = jax.jvp(loss, (x,), (jnp.sin(x),))[1]
        return jax.grad(loss)(x), central, forward

    reverse, central, forward = both(shapes)
    np.testing.assert_allclose(reverse.ravel()[::5], central, atol=2e-8)
    np.testing.assert_allclose(jnp.sum(reverse * jnp.sin(shapes)), forward, rtol=1e-8)


def test_plane_figures_and_vmap(x64):
    shapes, mask, _ = _shapes()
    flat = jnp.stack([shapes[..., :2], 2 * shapes[..., :2] + 1])
    one = lambda x: generalized_procrustes(x, mask)
    batch = jax.jit(jax.vmap(one))(flat)
    for i in range(2):
        single = one(flat[i])
        np.testing.assert_allclose(batch.mean[i], single.mean, atol=1e-10)
        assert batch.steps[i] == single.steps
        assert jax.tree.map(itemgetter(i), batch).result == single.result
    np.testing.assert_allclose(batch.mean[1], 2 * batch.mean[0], atol=1e-10)


def test_wrong_shapes_are_refused():
    with pytest.raises(GeometryError, match="shapes must have shape"):
        generalized_procrustes(np.zeros((5, 3)))
    with pytest.raises(GeometryError, match="mask must have shape"):
        generalized_procrustes(np.zeros((2, 5, 3)), np.ones(5, bool))
