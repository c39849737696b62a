"""Graduated non-convexity: a robust fit that starts from all pairs and lets go of the
wrong ones."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from .._core import RESULTS, failure_where, first_failure
from ..transforms import Rigid, Similarity, procrustes
from ._ransac import Consensus, Pairs, conclude, make_pairs, propose

_GROWTH = 1.4


class _State(eqx.Module):
    weights: Float[Array, " n"]
    sharpness: Float[Array, ""]
    transform: Rigid | Similarity
    steps: Int[Array, ""]
    undecided: Bool[Array, ""]


def gnc(
    source: Float[Array, "n d"],
    target: Float[Array, "n d"],
    *,
    threshold: Float[Array, ""] | float,
    init: Rigid | Similarity | None = None,
    mask: Bool[Array, " n"] | None = None,
    scaling: bool = False,
    min_inliers: int = 5,
    max_steps: int = 100,
) -> Consensus:
    """The transform that minimises sum_i min(|t_i - T(x_i)|^2, threshold^2), annealed.

    The truncated square is replaced by a smooth cost that is nearly convex at first
    (mu small) and sharpens by a factor of 1.4 a step. With r the distance of a pair and
    c the threshold, each step fits by `procrustes` with the weights
    1 for r^2 <= mu / (mu + 1) c^2, 0 for r^2 >= (mu + 1) / mu c^2 and
    c / r sqrt(mu (mu + 1)) - mu in between, until no weight is in between.

    **Arguments:** as in `ransac`, and

    - `init`: a good guess. The cost then starts half sharp (mu = 1) around it. Without
      one it starts from the least-squares fit to all pairs, which stands a large share
      of wrong pairs if these are not biased, but not with `scaling`, where wrong pairs
      shrink the fit: use `robust_procrustes` for that.
    - `max_steps`: the most fits.

    The result is `too_few_points` for fewer than d pairs, `no_consensus` below
    `min_inliers`, or `not_converged`. Derivatives are as in `ransac`.

    Source: Yang, Antonante, Tzoumas, Carlone 2020, Graduated non-convexity for robust
    spatial perception, section IV and remark 5.
    """
    pairs = make_pairs(source, target, mask, threshold)
    fixed = jax.lax.stop_gradient(pairs)
    guess, sharpness = _first(fixed, init, scaling)
    state = _anneal(fixed, guess, sharpness, scaling, max_steps)
    found = conclude(pairs, state.transform, scaling, min_inliers)
    stopped = failure_where(state.undecided, RESULTS.not_converged)
    result = first_failure(found.result, stopped)
    return eqx.tree_at(lambda x: x.result, found, result)


def robust_procrustes(
    source: Float[Array, "n d"],
    target: Float[Array, "n d"],
    *,
    threshold: Float[Array, ""] | float,
    key: Key[Array, ""],
    mask: Bool[Array, " n"] | None = None,
    scaling: bool = False,
    draws: int = 65_536,
    hypotheses: int = 1024,
    min_inliers: int = 5,
) -> Consensus:
    """The transform that most pairs agree on: random samples, then annealing.

    The best of the samples of `ransac` starts `gnc`; whichever of the two ends with the
    smaller sum_i min(|t_i - T(x_i)|^2, threshold^2) is returned. Arguments and statuses
    are those of `ransac`.
    """
    pairs = make_pairs(source, target, mask, threshold)
    fixed = jax.lax.stop_gradient(pairs)
    transforms, _ = propose(fixed, key, scaling, draws, hypotheses, 1)
    sampled = jax.tree.map(lambda x: x[0], transforms)
    guess, sharpness = _first(fixed, sampled, scaling)
    annealed = _anneal(fixed, guess, sharpness, scaling, 100).transform
    better = fixed.cost(annealed) < fixed.cost(sampled)
    best = jax.tree.map(lambda a, b: jnp.where(better, a, b), annealed, sampled)
    return conclude(pairs, best, scaling, min_inliers)


def _first(pairs: Pairs, init, scaling):
    """The transform and mu at the start."""
    if init is not None:
        like = lambda x: jnp.asarray(x, pairs.source.dtype)
        return jax.tree.map(like, jax.lax.stop_gradient(init)), like(1)
    fit = procrustes(pairs.source, pairs.target, mask=pairs.mask, scaling=scaling)
    worst = jnp.max(jnp.where(pairs.mask, pairs.squares(fit.transform), 0))
    room = 2 * worst / pairs.threshold**2 - 1
    # With every pair already near, the cost is sharp at once.
    sharp = 1 / jnp.finfo(room.dtype).eps
    return fit.transform, jnp.where(room > 1 / sharp, 1 / room, sharp)


def _weights(squares, sharpness, threshold):
    """The weights at mu, and whether each is strictly between 0 and 1."""
    low = sharpness / (sharpness + 1) * threshold**2
    high = (sharpness + 1) / sharpness * threshold**2
    between = (squares > low) & (squares < high)
    root = jnp.sqrt(jnp.where(between, squares, 1))
    soft = threshold / root * jnp.sqrt(sharpness * (sharpness + 1)) - sharpness
    return jnp.where(between, soft, squares <= low), between


def _anneal(pairs: Pairs, transform, sharpness, scaling, max_steps) -> _State:
    """The fit at the end of the schedule."""

    def step(state):
        squares = pairs.squares(state.transform)
        weights, between = _weights(squares, state.sharpness, pairs.threshold)
        fit = procrustes(pairs.source, pairs.target, weights, scaling=scaling)
        # A step that keeps too few pairs to fit anything would only lose the guess.
        usable = fit.result == RESULTS.successful
        moved = jax.tree.map(
            lambda a, b: jnp.where(usable, a, b), fit.transform, state.transform
        )
        changed = jnp.any(weights != state.weights)
        going = (jnp.any(between) | changed) & usable
        return _State(
            *(weights, _GROWTH * state.sharpness, moved, state.steps + 1, going)
        )

    start = _State(
        jnp.full(pairs.mask.shape, -1, pairs.source.dtype),
        sharpness,
        transform,
        jnp.zeros((), jnp.int32),
        jnp.asarray(True),
    )
    return jax.lax.while_loop(
        lambda s: s.undecided & (s.steps < max_steps), step, start
    )
