"""The transform that most of the given pairs of points agree on, by random samples.

Pairs of points keep their distances under a rigid motion, and the ratios of distances
under a similarity. Many samples of d pairs are drawn at once; those whose edges agree
are few, and only they are fitted and compared with all pairs.
"""

import itertools
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from .._core import RESULTS, check_shape, failure_where, first_failure, safe_norm
from ..transforms import Rigid, Similarity, procrustes

_REFINED = 32
_ROUNDS = 8


class Consensus(eqx.Module):
    """The transform target_from_source, the pairs that agree with it, and how well.

    `inliers` [n] are the pairs nearer than the threshold, `num_inliers` counts them,
    `rmse` is their rms distance, in the unit of the target.
    """

    target_from_source: Rigid | Similarity
    inliers: Bool[Array, " n"]
    num_inliers: Int[Array, ""]
    rmse: Float[Array, ""]
    result: RESULTS


class Pairs(eqx.Module):
    """Washed pairs of points: row i of the source belongs to row i of the target."""

    source: Float[Array, "n d"]
    target: Float[Array, "n d"]
    mask: Bool[Array, " n"]
    threshold: Float[Array, ""]

    def squares(self, transform) -> Float[Array, " n"]:
        """The squared distance of every pair; infinite for padding."""
        gaps = transform(self.source) - self.target
        return jnp.where(self.mask, jnp.sum(gaps**2, axis=1), jnp.inf)

    def cost(self, transform) -> Float[Array, ""]:
        """The sum of min(distance^2, threshold^2)."""
        return jnp.sum(jnp.minimum(self.squares(transform), self.threshold**2))

    def inliers(self, transform) -> Bool[Array, " n"]:
        """The pairs within the threshold."""
        return self.squares(transform) <= self.threshold**2


def ransac(
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
    """The minimiser of sum_i min(|t_i - T(x_i)|^2, threshold^2), by random samples.

    `draws` samples of d pairs are drawn. Of those whose distances agree (in space, the
    three edges of the triangles differ by at most the threshold, and are longer than
    twice the threshold) the first `hypotheses` are fitted by `procrustes` and compared
    with all pairs; the 32 best are fitted again to their inliers, eight times, and the
    best of all is returned.

    **Arguments:**

    - `source`, `target`: [n, d] pairs, row by row, of which many may be wrong.
    - `threshold`: the largest distance of a right pair, in the unit of the target.
    - `key`: the answer is a function of the data and the key.
    - `mask`: [n], False for rows to ignore. Rows that are not finite are ignored too.
    - `scaling`: fit a `Similarity`.
    - `min_inliers`: fewer are no consensus. Chance agreement grows with n.

    With a share p of right pairs, about p^d draws of them are good: 65 536 draws leave
    a comfortable margin down to p = 0.05 in space. The result is `too_few_points` for
    fewer than d pairs, and `no_consensus` below `min_inliers`; the transform is finite.
    Inliers are constants under differentiation, the transform is differentiable as the
    `procrustes` fit to them. Raises `GeometryError` for shapes that do not agree.

    Source: Fischler and Bolles 1981; the cost is that of Torr and Zisserman 2000.
    """
    pairs = make_pairs(source, target, mask, threshold)
    fixed = jax.lax.stop_gradient(pairs)
    transforms, _ = propose(fixed, key, scaling, draws, hypotheses, 1)
    best = jax.tree.map(lambda x: x[0], transforms)
    return conclude(pairs, best, scaling, min_inliers)


def make_pairs(source, target, mask, threshold) -> Pairs:
    """Checked and washed pairs."""
    check_shape("source", source, (None, None))
    check_shape("target", target, source.shape)
    source, target = jnp.asarray(source), jnp.asarray(target)
    real = jnp.all(jnp.isfinite(source) & jnp.isfinite(target), axis=1)
    if mask is not None:
        check_shape("mask", mask, (source.shape[0],))
        real = real & mask
    wash = lambda x: jnp.where(real[:, None], x, 0)
    threshold = jnp.asarray(threshold, source.dtype)
    return Pairs(wash(source), wash(target), real, threshold)


def conclude(pairs: Pairs, transform, scaling, min_inliers) -> Consensus:
    """The fit to the inliers of a transform."""
    # Which pairs are inliers is piecewise constant.
    inliers = pairs.inliers(jax.lax.stop_gradient(transform))
    fit = procrustes(pairs.source, pairs.target, mask=inliers, scaling=scaling)
    usable = fit.result == RESULTS.successful
    best = jax.tree.map(lambda a, b: jnp.where(usable, a, b), fit.transform, transform)
    count = jnp.sum(inliers)
    result = first_failure(
        failure_where(
            jnp.sum(pairs.mask) < pairs.source.shape[1], RESULTS.too_few_points
        ),
        failure_where((count < min_inliers) | ~usable, RESULTS.no_consensus),
    )
    return Consensus(best, inliers, count, fit.rmse, result)


def propose(pairs: Pairs, key, scaling, draws, hypotheses, keep):
    """The `keep` best refined transforms (batched, best first) and their costs."""
    samples = _draw(key, pairs, draws)
    good = _edges_agree(pairs, samples, scaling)
    (first,) = jnp.nonzero(good, size=hypotheses, fill_value=draws)
    there = first < draws
    samples = samples[jnp.where(there, first, 0)]
    fit = jax.vmap(
        lambda i: procrustes(pairs.source[i], pairs.target[i], scaling=scaling)
    )(samples)
    usable = there & (fit.result == RESULTS.successful)
    cost = _costs(pairs, fit.transform)
    order = jnp.argsort(jnp.where(usable, cost, jnp.inf))[: max(_REFINED, keep)]
    some = jax.tree.map(lambda x: x[order], fit.transform)
    refined = jax.vmap(partial(_refine, pairs, scaling=scaling))(some)
    cost = jnp.where(usable[order], _costs(pairs, refined), jnp.inf)
    order = jnp.argsort(cost)[:keep]
    return jax.tree.map(lambda x: x[order], refined), cost[order]


def _costs(pairs, transforms):
    return jax.lax.map(pairs.cost, transforms, batch_size=32)


def _draw(key, pairs, draws) -> Int[Array, "draws d"]:
    """Rows of d different pairs each, uniformly among the real ones."""
    count = jnp.sum(pairs.mask)
    # Real rows first: what is drawn does not depend on padding.
    order = jnp.argsort(~pairs.mask, stable=True).astype(jnp.int32)
    chosen = []
    for i, part in enumerate(jax.random.split(key, pairs.source.shape[1])):
        pick = jax.random.randint(part, (draws,), 0, jnp.maximum(count - i, 1))
        # The pick-th of those not yet chosen.
        earlier = jnp.sort(jnp.stack(chosen), axis=0) if chosen else []
        for other in earlier:
            pick = pick + (pick >= other)
        chosen.append(pick)
    rows = jnp.minimum(jnp.stack(chosen, axis=1), pairs.mask.shape[0] - 1)
    return order[rows]


def _edges_agree(pairs, samples, scaling) -> Bool[Array, " draws"]:
    """Whether all distances within a sample are kept, up to the threshold."""
    d = samples.shape[1]
    edge = lambda x, i, j: safe_norm(x[samples[:, i]] - x[samples[:, j]])
    ends = list(itertools.combinations(range(d), 2))
    here = jnp.stack([edge(pairs.source, i, j) for i, j in ends])
    there = jnp.stack([edge(pairs.target, i, j) for i, j in ends])
    if scaling:
        total = jnp.sum(here, axis=0)
        here = here * (jnp.sum(there, axis=0) / jnp.where(total > 0, total, 1))
    # Shorter edges agree whatever the pairs are.
    shortest = jnp.minimum(jnp.min(here, axis=0), jnp.min(there, axis=0))
    long = shortest > 2 * pairs.threshold
    # Right pairs may differ by twice the threshold, but few do; wrong ones would.
    agree = jnp.all(jnp.abs(here - there) <= pairs.threshold, axis=0)
    return (jnp.sum(pairs.mask) >= d) & long & agree


def _refine(pairs, transform, scaling):
    """Fitted to its inliers again and again; the best along the way."""

    def round_(carry, _):
        transform, best, least = carry
        mask = pairs.inliers(transform)
        fit = procrustes(pairs.source, pairs.target, mask=mask, scaling=scaling)
        usable = fit.result == RESULTS.successful
        pick = lambda use, new, old: jax.tree.map(
            lambda a, b: jnp.where(use, a, b), new, old
        )
        transform = pick(usable, fit.transform, transform)
        cost = pairs.cost(transform)
        better = cost < least
        return (
            transform,
            pick(better, transform, best),
            jnp.minimum(cost, least),
        ), None

    start = (transform, transform, pairs.cost(transform))
    (_, best, _), _ = jax.lax.scan(round_, start, None, length=_ROUNDS)
    return best
