"""The plane, sphere or cylinder that most points agree on."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import RESULTS, GeometryError, failure_where, first_failure, message
from ..shapes import PointCloud
from ._primitives import AbstractModel, AbstractPrimitive, Plane, refit, spread_of

# Gauss-Newton steps on the inliers, twice; hypotheses scored at once.
_STEPS = 5
_TOGETHER = 16


class PrimitiveFit(eqx.Module):
    """A primitive and the points within the threshold of it.

    `rmse` is that of the distances of the inliers [n]. `result` is `too_few_points`
    for fewer real points than a sample, `no_consensus` where no more points agree than
    any sample does.
    """

    primitive: AbstractPrimitive
    inliers: Bool[Array, " n"]
    num_inliers: Int[Array, ""]
    rmse: Float[Array, ""]
    result: RESULTS


def fit_primitive(
    cloud: PointCloud,
    model: AbstractModel | None = None,
    *,
    threshold: Float[Array, ""] | float,
    key: Array,
    num_hypotheses: int = 512,
) -> PrimitiveFit:
    """The primitive with most real points within `threshold` of it, refined on them.

    Each of `num_hypotheses` (static) goes through a random minimal sample; the one with
    the most inliers is improved by least squares on its inliers, twice. `model` is
    `Plane()` (the default), `Sphere()` or `Cylinder()`, which needs normals;
    `threshold` is in the unit of the points. `key` is a typed key, used once: the same
    key gives the same answer, padding or not. Differentiable in the points through the
    last steps. Raises `GeometryError` where normals are missing.

    Source: M. A. Fischler, R. C. Bolles, Random sample consensus, 1981.
    """
    model = Plane() if model is None else model
    if model.needs_normals and cloud.normals is None:
        must = f"{type(model).__name__} samples need normals"
        fix = "Estimate them with normals.estimate."
        raise GeometryError(message(must, "a cloud without normals", fix))
    clean = cloud.washed()
    mask = jnp.asarray(cloud.mask) & jnp.all(jnp.isfinite(clean.points), axis=1)
    shift, scale, points = _normalised(jnp.where(mask[:, None], clean.points, 0), mask)
    gate = jnp.asarray(threshold, points.dtype) / scale
    still = jax.lax.stop_gradient(points)
    best = _best(model, still, clean.normals, mask, gate, key, num_hypotheses)
    for _ in range(2):
        best = refit(best, points, _near(best, points, mask, gate), _STEPS)
    weights = _near(best, points, mask, gate)
    spread = spread_of(best.heights(points), weights) * scale
    count, real = jnp.sum(weights).astype(jnp.int32), jnp.sum(mask)
    result = first_failure(
        failure_where(real < model.sample_size, RESULTS.too_few_points),
        failure_where(count <= model.sample_size, RESULTS.no_consensus),
    )
    return PrimitiveFit(best.moved(shift, scale), weights > 0, count, spread, result)


def _normalised(points, mask):
    """The points about their mean, over their size: squares keep their digits."""
    count = jnp.maximum(jnp.sum(mask), 1)
    shift = jax.lax.stop_gradient(jnp.sum(points, axis=0) / count)
    away = jnp.where(mask[:, None], points - shift, 0)
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(away)))
    scale = jnp.where(size > 0, size, 1)
    return shift, scale, away / scale


def _best(model, points, normals, mask, gate, key, num) -> AbstractPrimitive:
    """The hypothesis with the most inliers; ties go to the first."""
    rows = _samples(mask, key, num, model.sample_size)
    oriented = points if normals is None else jax.lax.stop_gradient(normals)

    def score(row):
        found = model.through(points[row], oriented[row])
        finite = jnp.all(
            jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(found)])
        )
        found = jax.tree.map(lambda x: jnp.where(finite, x, 0), found)
        count = jnp.sum(_near(found, points, mask, gate))
        return jnp.where(finite, count, -1), found

    counts, found = jax.lax.map(score, rows, batch_size=_TOGETHER)
    return jax.tree.map(lambda x: x[jnp.argmax(counts)], found)


def _samples(mask, key, num, size):
    """Different real rows [num, size] for every hypothesis."""
    real = jnp.argsort(~mask, stable=True)
    count = jnp.sum(mask)
    picks = jax.random.uniform(key, (num, size))
    # Draw without replacement: the i-th of what is left, past what was taken.
    taken = []
    for i in range(size):
        left = jnp.maximum(count - i, 1)
        pick = jnp.minimum(jnp.floor(picks[:, i] * left).astype(jnp.int32), left - 1)
        ordered = jnp.sort(jnp.stack(taken), axis=0) if taken else []
        for other in ordered:
            pick = pick + (pick >= other)
        taken.append(pick)
    return real[jnp.stack(taken, axis=1)]


def _near(primitive, points, mask, gate):
    """1 for the points within the gate, 0 for others."""
    heights = jax.lax.stop_gradient(primitive.heights(points))
    return (mask & (jnp.abs(heights) <= gate)).astype(points.dtype)
