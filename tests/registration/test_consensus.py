"""RANSAC and graduated non-convexity: pairs of which many are wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.registration import gnc, ransac, robust_procrustes
from jaxgeom.transforms import procrustes

N, THRESHOLD = 100, 0.03
KEY = jax.random.key(4)
TURN = Rotation.from_rotvec([0.7, -1.9, 0.4]).as_matrix()


def _settings(scaling):
    return dict(threshold=THRESHOLD, scaling=scaling, min_inliers=6)


def _sampled(source, target, mask, key=KEY, scaling=True):
    return ransac(source, target, mask=mask, key=key, **_settings(scaling))


robust = jax.jit(
    lambda source, target, mask, threshold, key: robust_procrustes(
        source, target, mask=mask, threshold=threshold, key=key, scaling=True
    )
)
sampled = jax.jit(_sampled)
annealed = jax.jit(
    lambda source, target, mask: gnc(source, target, mask=mask, **_settings(False))
)


def _pairs(share, noise=0.002, scale=1.7, dtype=np.float32):
    """Pairs of which the given share is wrong, and which ones are right."""
    rng = np.random.default_rng(8)
    source = rng.uniform(-1, 1, (N, 3))
    target = scale * source @ TURN.T + [0.5, 2.0, -1.0]
    target = target + noise * rng.normal(size=target.shape)
    wrong = rng.permutation(N) < share * N
    target[wrong] = rng.uniform(-2, 2, (wrong.sum(), 3))
    return source.astype(dtype), target.astype(dtype), ~wrong


def _problem(folder):
    """A stored problem: pairs, the similarity, and the bound of the noise."""
    read = lambda name: np.loadtxt(folder / f"{name}_ref.csv", delimiter=",")
    points = lambda name: np.loadtxt(
        (folder / f"{name}.ply").read_text().split("end_header\n")[1].splitlines()
    )
    bound = float((folder / "parameters.txt").read_text().split("Noise Bound:")[1])
    truth = float(read("s")), read("R"), read("t").ravel()
    return points("src"), points("dst"), truth, bound


def _errors(transform, truth):
    scale, rotation, shift = truth
    turn = Rotation.from_matrix(np.asarray(transform.rotation, float) @ rotation.T)
    off = np.linalg.norm(np.asarray(transform.translation) - shift)
    return np.array([turn.magnitude(), off, abs(float(transform.scale) - scale)])


# Every size is a program of its own.
@pytest.mark.parametrize(
    "number", [1, 2, 3, pytest.param(4, marks=pytest.mark.slow), 5, 6]
)
def test_stored_problems_are_solved(number, data):
    source, target, truth, bound = _problem(
        data / f"registration/teaser/benchmark_{number}"
    )
    scale, rotation, shift = truth
    true = np.linalg.norm(scale * source @ rotation.T + shift - target, axis=1)
    # The stated bound of the exact problems is below the rounding of a float32.
    bound = max(bound, 1e-4)
    pad = lambda x: np.pad(x, ((0, N - len(x)), (0, 0))).astype(np.float32)
    mask = np.arange(N) < len(source)
    found = robust(pad(source), pad(target), mask, np.float32(bound), KEY)
    assert found.result == RESULTS.successful
    inliers = np.asarray(found.inliers)[: len(source)]
    np.testing.assert_array_equal(inliers, true <= bound)
    best = procrustes(source, target, mask=inliers, scaling=True).transform
    floor = _errors(best, truth)
    # The noisy problem determines its answer no better than the fit to the right pairs.
    assert number == 6 or floor.max() < 1e-5
    assert np.all(_errors(found.target_from_source, truth) <= floor + 1e-5)


def test_samples_find_the_right_pairs():
    for share in (0.0, 0.5, 0.9):
        source, target, right = _pairs(share)
        found = sampled(source, target, np.ones(N, bool))
        assert found.result == RESULTS.successful
        np.testing.assert_array_equal(found.inliers, right)
        best = procrustes(source, target, mask=right, scaling=True)
        expected = best.transform.matrix()
        np.testing.assert_allclose(
            found.target_from_source.matrix(), expected, atol=1e-5
        )
        np.testing.assert_allclose(found.rmse, best.rmse, rtol=1e-3)


def test_annealing_needs_no_start():
    for share in (0.0, 0.3, 0.6):
        source, target, right = _pairs(share, scale=1)
        found = annealed(source, target, np.ones(N, bool))
        assert found.result == RESULTS.successful
        np.testing.assert_array_equal(found.inliers, right)


def test_annealing_from_a_guess():
    source, target, right = _pairs(0.85, scale=1)
    near = procrustes(source, target, mask=right).transform
    found = gnc(source, target, init=near, **_settings(False))
    assert found.result == RESULTS.successful
    np.testing.assert_array_equal(found.inliers, right)
    short = gnc(source, target, max_steps=1, **_settings(False))
    assert short.result == RESULTS.no_consensus
    exact, moved, _ = _pairs(0.2, scale=1)
    halted = gnc(exact, moved, threshold=0.5, max_steps=1)
    assert halted.result == RESULTS.not_converged


def test_padding_and_keys():
    source, target, right = _pairs(0.5)
    mask = np.arange(N) < 70
    fit = lambda fill: sampled(
        np.where(mask[:, None], source, fill), target, mask
    ).target_from_source.matrix()
    expected = fit(0)
    for fill in (1e20, np.nan):
        np.testing.assert_array_equal(fit(np.float32(fill)), expected)
    np.testing.assert_array_equal(fit(0), expected)
    other = sampled(source, target, mask, jax.random.key(77))
    np.testing.assert_array_equal(other.inliers, right & mask)


@pytest.mark.slow
def test_derivative_is_that_of_the_fit_to_the_inliers():
    source, target, right = _pairs(0.5)
    mask = np.ones(N, bool)
    loss = lambda x, fit: jnp.sum(fit(x) ** 2)
    by_samples = lambda x: sampled(x, target, mask).target_from_source.matrix()
    by_fit = lambda x: procrustes(
        x, target, mask=right, scaling=True
    ).transform.matrix()
    slope = jax.grad(lambda x: loss(x, by_samples))(jnp.asarray(source))
    expected = jax.grad(lambda x: loss(x, by_fit))(jnp.asarray(source))
    np.testing.assert_allclose(slope, expected, rtol=2e-3, atol=1e-4)
    assert np.abs(expected).max() > 0.1 and not np.any(slope[~right])


def test_statuses_and_vmap():
    source, target, right = _pairs(0.5)
    noise = np.random.default_rng(0).uniform(-2, 2, (N, 3)).astype(np.float32)
    few = np.arange(N) < 2
    sources = jnp.stack([source, source, source])
    targets = jnp.stack([target, noise, target])
    masks = jnp.stack([few | True, few | True, few])
    batch = jax.jit(jax.vmap(_sampled))(sources, targets, masks)
    expected = [RESULTS.successful, RESULTS.no_consensus, RESULTS.too_few_points]
    for i, status in enumerate(expected):
        single = sampled(sources[i], targets[i], masks[i])
        assert single.result == status
        for a, b in zip(*map(jax.tree.leaves, (batch, single)), strict=True):
            assert np.isfinite(b).all()
            np.testing.assert_allclose(a[i], b, atol=1e-5)


def test_wrong_shapes_are_refused():
    for call in (ransac, robust_procrustes):
        with pytest.raises(GeometryError, match="target must have shape"):
            call(np.zeros((5, 3)), np.zeros((4, 3)), threshold=0.1, key=KEY)
    with pytest.raises(GeometryError, match="mask must have shape"):
        gnc(np.zeros((5, 3)), np.zeros((5, 3)), threshold=0.1, mask=np.ones(2, bool))
