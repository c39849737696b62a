"""The derivative of a converged alignment against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from jaxgeom import PointCloud, Rigid
from jaxgeom.neighbors import BruteForce
from jaxgeom.registration import (
    L2,
    FixedWidth,
    Method,
    Nearest,
    PointToPlane,
    Symmetric,
    Tukey,
    Welsch,
    icp,
    icp_unrolled,
    pose_covariance,
    sandwich_covariance,
)

N, M, STEP = 60, 200, 1e-5
PAIRS = Nearest(backend=BruteForce())


def _scene(seed):
    """Source, target, their normals and weights; noise keeps the residuals apart."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(M, 3))
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    normals = x / [1.0, 0.7, 0.5]
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    points = x * [1.0, 0.7, 0.5]
    move = Rigid.exp(jnp.asarray([0.03, -0.05, 0.02, 0.01, -0.02, 0.03])).inverse()
    source = move(points[:N] + 0.01 * rng.normal(size=(N, 3)))
    weights = rng.uniform(0.5, 2, N)
    width = jnp.asarray(0.08)
    return source, move.normals(normals[:N]), points, normals, weights, width


def _pose(objective, solve, *parts):
    source, normals, target, target_normals, weights, width = parts
    method = Method(
        correspondence=PAIRS, objective=objective, kernel=Tukey(FixedWidth(width))
    )
    clouds = PointCloud(source, normals), PointCloud(target, target_normals)
    return solve(*clouds, method=method, weights=weights, max_distance=0.3)


def _number(found):
    """A number that every entry of the pose moves."""
    pose = found.target_from_source
    table = jnp.arange(1.0, 10.0).reshape(3, 3)
    return jnp.sum(table * pose.rotation) + pose.translation @ table[1]


@pytest.mark.parametrize(
    "objective",
    [PointToPlane(), pytest.param(Symmetric(), marks=pytest.mark.slow)],
    ids=str,
)
def test_implicit_derivative_is_that_of_the_answer(objective, x64):
    parts = _scene(0)
    loss = jax.jit(lambda parts: _number(_pose(objective, icp, *parts)))
    slope = jax.jit(jax.grad(lambda parts: _number(_pose(objective, icp, *parts))))
    slopes = slope(parts)
    rng = np.random.default_rng(1)
    for i, part in enumerate(parts):
        way = jnp.asarray(rng.normal(size=part.shape)) * 0.3
        shift = lambda a, i=i, way=way: (
            *parts[:i],
            parts[i] + a * way,
            *parts[i + 1 :],
        )
        central = (loss(shift(STEP)) - loss(shift(-STEP))) / (2 * STEP)
        np.testing.assert_allclose(
            jnp.sum(slopes[i] * way), central, rtol=1e-5, atol=1e-8
        )
        used = objective == Symmetric() or i != 1
        assert (np.abs(slopes[i]).max() > 1e-6) == used


@pytest.mark.slow
def test_forward_reverse_and_unrolled_agree(x64):
    parts = _scene(0)
    loss = lambda parts: _number(_pose(Symmetric(), icp, *parts))
    slopes = jax.jit(jax.grad(loss))(parts)
    way = jax.tree.map(lambda x: jnp.cos(jnp.arange(x.size)).reshape(x.shape), parts)
    _, push = jax.jit(lambda p, w: jax.jvp(loss, (p,), (w,)))(parts, way)
    total = sum(jnp.sum(a * b) for a, b in zip(slopes, way, strict=True))
    np.testing.assert_allclose(push, total, rtol=1e-8)
    table = jnp.arange(1.0, 10.0).reshape(3, 3)

    def unrolled(parts):
        pose = _pose(Symmetric(), icp_unrolled, *parts)
        return jnp.sum(table * pose.rotation) + pose.translation @ table[1]

    slow = jax.jit(jax.grad(unrolled))(parts)
    for a, b in zip(slow, slopes, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)


def test_padding_has_no_gradient(x64):
    source, normals, target, target_normals, weights, width = _scene(0)
    mask = jnp.arange(N) < N - 7

    def loss(source):
        method = Method(correspondence=PAIRS, kernel=Welsch(FixedWidth(width)))
        clouds = PointCloud(source, normals, mask), PointCloud(target, target_normals)
        return _number(icp(*clouds, method=method, max_distance=0.3))

    slope = jax.jit(jax.grad(loss))(source)
    assert not np.any(slope[N - 7 :]) and np.all(np.any(slope[: N - 20] != 0, axis=1))


@pytest.mark.slow
@pytest.mark.parametrize("kernel", [L2(), Tukey()], ids=["L2", "Tukey"])
def test_covariance_is_that_of_many_draws(kernel, x64):
    _, _, target, target_normals, _, _ = _scene(0)
    truth = Rigid.exp(jnp.asarray([0.01, 0.02, 0.0, 0.01, 0.0, 0.0]))
    clean, sigma = truth.inverse()(target), 0.005

    def draw(key):
        noisy = clean + sigma * jax.random.normal(key, clean.shape)
        clouds = PointCloud(noisy), PointCloud(target, target_normals)
        found = icp(*clouds, method=Method(kernel=kernel))
        xi = (found.target_from_source @ truth.inverse()).log()
        return xi, (pose_covariance(found), sandwich_covariance(found))

    keys = jax.random.split(jax.random.key(2), 500)
    xi, predicted = jax.jit(lambda keys: jax.lax.map(draw, keys, batch_size=50))(keys)
    seen = np.cov(xi.T)
    for covariance in predicted:
        ratio = np.diagonal(np.mean(covariance, axis=0)) / np.diagonal(seen)
        assert np.all((ratio > 0.8) & (ratio < 1.25)), ratio
        inside = np.einsum("bi,bij,bj->b", xi, np.linalg.inv(covariance), xi)
        cover = np.mean(inside <= chi2.ppf(0.95, 6))
        assert 0.90 <= cover <= 0.98, cover
