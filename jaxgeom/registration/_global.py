"""The alignment of two scans of which nothing is known but the scale."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from .._core import RESULTS, GeometryError, failure_where, first_failure, message
from ..clouds import thin
from ..neighbors import build, knn
from ..shapes import PointCloud
from ..transforms import Rigid, procrustes
from ._features import fpfh, match_features
from ._ransac import conclude, make_pairs, propose

_FACING = 0.7
_POLISHED = 4
# In voxels: the ball that a feature describes, and the distance of a right pair.
_RADIUS = 5.0
_THRESHOLD = 1.5


class GlobalStart(eqx.Module):
    """A rough alignment target_from_source, and how far to trust it.

    `num_matches` pairs of features were matched, `num_inliers` of them agree with the
    transform. `fitness` is the share of the thinned source that has a target point with
    a similar normal within the threshold, `rmse` the rms distance of these.
    """

    target_from_source: Rigid
    num_matches: Int[Array, ""]
    num_inliers: Int[Array, ""]
    fitness: Float[Array, ""]
    rmse: Float[Array, ""]
    result: RESULTS


def align_features(
    source: PointCloud,
    target: PointCloud,
    *,
    voxel_size: Float[Array, ""] | float,
    key: Key[Array, ""],
    capacity: int = 4096,
    neighbors: int = 64,
    draws: int = 131_072,
    hypotheses: int = 2048,
    kept: int = 32,
    polish: int = 10,
    min_inliers: int = 8,
) -> GlobalStart:
    """A rough alignment of two scans, without a start.

    Both are thinned to one point per voxel, described by `fpfh` in balls of five
    voxels, and matched. Of the `kept` best transforms of random samples of the matches
    (see `ransac`, threshold 1.5 voxels) the four that cover most of the source are
    polished by closest points with similar normals; the one that then covers most wins.

    **Arguments:**

    - `source`, `target`: with oriented normals, such as of
      `orient_toward_viewpoint(estimate(cloud), scanner)`, in one unit of length.
    - `voxel_size`: about 1/40 of the size of the scans.
    - `key`: the answer is a function of the data and the key.
    - `capacity`: room for thinned points, static.
    - `neighbors`: the most that a feature looks at.
    - `draws`, `hypotheses`: as in `ransac`.
    - `polish`: closest-point steps of the four transforms.
    - `min_inliers`: fewer matches in agreement are no consensus.

    The result is `capacity_exceeded` where a thinned cloud does not fit, or
    `too_few_points` or `no_consensus`. A rough alignment is a discrete choice: it is a
    constant under differentiation. Raises `GeometryError` for clouds without normals.
    """
    describe = lambda cloud: describe_view(
        cloud, voxel_size=voxel_size, capacity=capacity, neighbors=neighbors
    )
    return align_views(
        describe(source),
        describe(target),
        key=key,
        draws=draws,
        hypotheses=hypotheses,
        kept=kept,
        polish=polish,
        min_inliers=min_inliers,
    )


class View(eqx.Module):
    """A thinned scan with the features of its points, ready to be matched.

    `required` is the number of voxels that the scan occupies, `voxel_size` their side.
    """

    cloud: PointCloud
    features: Float[Array, "n 33"]
    required: Int[Array, ""]
    voxel_size: Float[Array, ""]


def describe_view(
    cloud: PointCloud,
    *,
    voxel_size: Float[Array, ""] | float,
    capacity: int = 4096,
    neighbors: int = 64,
) -> View:
    """What `align_views` needs of one scan; arguments as in `align_features`.

    Raises `GeometryError` for a cloud without normals.
    """
    _check_normals(cloud)
    size = jnp.asarray(voxel_size, cloud.points.dtype)
    thinned, required = thin(jax.lax.stop_gradient(cloud), size, capacity)
    look = fpfh(thinned, radius=_RADIUS * size, k=neighbors)
    return View(thinned, look, required, size)


def align_views(
    source: View,
    target: View,
    *,
    key: Key[Array, ""],
    draws: int = 131_072,
    hypotheses: int = 2048,
    kept: int = 32,
    polish: int = 10,
    min_inliers: int = 8,
) -> GlobalStart:
    """`align_features` for scans that are described already."""
    views = jax.lax.stop_gradient((source, target))
    source, target = (view.cloud for view in views)
    looks = [view.features for view in views]
    matches = match_features(*looks, source_mask=source.mask, target_mask=target.mask)
    there = target.points.at[matches.indices].get(mode="fill", fill_value=0)
    threshold = _THRESHOLD * views[0].voxel_size
    pairs = make_pairs(source.points, there, matches.mask, threshold)
    guesses, _ = propose(pairs, key, False, draws, hypotheses, kept)
    best, fitness, rmse = _best_cover(source, target, guesses, threshold, polish)
    agreed = conclude(pairs, best, False, min_inliers)
    overflow = [v.required > v.cloud.mask.shape[0] for v in views]
    result = first_failure(
        failure_where(overflow[0] | overflow[1], RESULTS.capacity_exceeded),
        agreed.result,
    )
    count = jnp.sum(matches.mask)
    return GlobalStart(best, count, agreed.num_inliers, fitness, rmse, result)


def _best_cover(source, target, guesses, threshold, polish):
    """The guess that, polished, brings most of the source onto the target."""
    index = build(target.points, target.mask)
    count = jnp.maximum(jnp.sum(source.mask), 1).astype(threshold.dtype)

    def judged(guess):
        square, use, _ = _cover(source, target, index, guess, threshold)
        score = jnp.sum(jnp.where(use, threshold**2 - square, 0))
        found = jnp.sum(use).astype(threshold.dtype)
        total = jnp.sum(jnp.where(use, square, 0))
        return score, found / count, jnp.sqrt(total / jnp.maximum(found, 1))

    def polished(guess):
        step = lambda _, guess: _closer(source, target, index, guess, threshold)
        guess = jax.lax.fori_loop(0, polish, step, guess)
        return guess, *judged(guess)

    # One at a time: together every search would wait for the longest.
    score, _, _ = jax.lax.map(judged, guesses)
    first = jax.lax.top_k(score, min(_POLISHED, score.shape[0]))[1]
    some = jax.tree.map(lambda x: x[first], guesses)
    refined, score, fitness, rmse = jax.lax.map(polished, some)
    best = jnp.argmax(score)
    return jax.tree.map(lambda x: x[best], (refined, fitness, rmse))


def _closer(source, target, index, guess, threshold):
    """One closest-point step."""
    _, use, there = _cover(source, target, index, guess, threshold)
    fit = procrustes(source.points, target.points[there], mask=use)
    usable = fit.result == RESULTS.successful
    return jax.tree.map(lambda a, b: jnp.where(usable, a, b), fit.transform, guess)


def _cover(source, target, index, guess, threshold):
    """Squared distances to the nearest target points, where these count, and which."""
    near = knn(index, guess(source.points), 1, mask=source.mask, max_distance=threshold)
    found = near.mask[:, 0]
    there = jnp.where(found, near.indices[:, 0], 0)
    facing = jnp.sum(guess.normals(source.normals) * target.normals[there], axis=1)
    return near.distances[:, 0] ** 2, found & (facing > _FACING), there


def _check_normals(*clouds):
    if any(cloud.normals is None for cloud in clouds):
        raise GeometryError(
            message(
                "both clouds need oriented normals",
                "normals=None",
                "Call normals.estimate and orient_toward_viewpoint first.",
            )
        )
