"""The best rigid motion or similarity between points that belong together."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import (
    RESULTS,
    GeometryError,
    check_shape,
    failure_where,
    first_failure,
    message,
    safe_divide,
)
from ._polar import polar
from ._transforms import Rigid, Similarity


class ProcrustesFit(eqx.Module):
    """The best transform, its weighted rms distance, and whether it is unique.

    `transform` is a `Rigid`, or with scaling a `Similarity`: target_from_source.
    """

    transform: Rigid | Similarity
    rmse: Float[Array, ""]
    result: RESULTS


class _Moments(eqx.Module):
    """Points about their centroid, in units of their size (so that squares neither
    overflow nor vanish), and the mean of the squares."""

    center: Float[Array, " d"]
    size: Float[Array, ""]
    unit: Float[Array, "n d"]
    variance: Float[Array, ""]


def procrustes(
    source: Float[Array, "n d"],
    target: Float[Array, "n d"],
    weights: Float[Array, " n"] | None = None,
    *,
    mask: Bool[Array, " n"] | None = None,
    scaling: bool = False,
    reflection: bool = False,
) -> ProcrustesFit:
    """The transform that minimises sum_i w_i |t_i - (s R x_i + t)|^2, in closed form.

    With centroids mx, mt and H = sum w (t_i - mt)(x_i - mx)^T = U S V^T:
    R = U D V^T, D = diag(1, ..., det(U V^T)), s = tr(S D) / sum w |x_i - mx|^2,
    t = mt - s R mx; the rmse is the root of the minimum over sum w.

    **Arguments:**

    - `source`, `target`: [n, d] rows that belong together, d >= 2, in one unit or, with
      `scaling`, in two.
    - `weights`: [n] nonnegative, or None for equal ones.
    - `mask`: [n], False for rows to ignore. Rows that are not finite are ignored too.
    - `scaling`: also fit s > 0 (otherwise s = 1).
    - `reflection`: allow det R = -1 where that is better. It is never returned
      otherwise. A reflection has no logarithm.

    The result is `too_few_points` below d rows of positive weight, and
    `degenerate_input` where the rotation is not unique: points that coincide or (in
    space) lie on a line. The transform is then one of the best, and finite. Derivatives
    exist wherever the rotation is unique, planar and symmetric points included.
    Raises `GeometryError` for shapes that do not agree.

    Source: Umeyama 1991, Least-squares estimation of transformation parameters between
    two point patterns, eq. 40 to 43.
    """
    _check_pairs(source, target)
    source, target = _as_floats(source, target)
    share, real = shares(source, target, weights, mask)
    x, y = _moments(source, share, real), _moments(target, share, real)
    covariance = (share[:, None] * y.unit).T @ x.unit
    rotation, spectrum = polar(covariance, reflection)
    scale = jnp.ones_like(x.size)
    if scaling:
        scale = _scale(covariance, rotation, x, y)
    rmse = _rmse(share, x, y, scale * rotation)
    shift = y.center - scale * (rotation @ x.center)
    transform = Rigid(rotation, shift)
    if scaling:
        transform = Similarity(scale, rotation, shift)
    few = jnp.sum(share > 0) < source.shape[1]
    result = first_failure(
        failure_where(few, RESULTS.too_few_points),
        failure_where(_ambiguous(spectrum, share, x, y), RESULTS.degenerate_input),
    )
    return ProcrustesFit(transform, rmse, result)


def shares(source, target, weights, mask):
    """The weights over their sum, zero for rows to ignore, and the rows that count."""
    real = jnp.all(jnp.isfinite(source) & jnp.isfinite(target), axis=-1)
    if mask is not None:
        check_shape("mask", mask, (source.shape[0],))
        real = real & mask
    weights = jnp.ones(source.shape[0]) if weights is None else jnp.asarray(weights)
    check_shape("weights", weights, (source.shape[0],))
    weights = jnp.where(real, weights, 0).astype(source.dtype)
    # A common factor cancels; without it the sum of tiny weights would vanish.
    peak = jax.lax.stop_gradient(jnp.max(weights, initial=0))
    weights = safe_divide(weights, peak)
    return safe_divide(weights, jnp.sum(weights)), real


def _as_floats(source, target):
    source, target = jnp.asarray(source), jnp.asarray(target)
    dtype = jnp.result_type(source, target)
    dtype = dtype if jnp.issubdtype(dtype, jnp.floating) else jnp.result_type(float)
    return source.astype(dtype), target.astype(dtype)


def _moments(points, share, real) -> _Moments:
    points = jnp.where(real[:, None], points, 0)
    # Centered twice: the first mean of points far from the origin is rounded.
    first = share @ points
    more = share @ (points - first)
    centered = jnp.where(real[:, None], points - first - more, 0)
    counted = jnp.where((share > 0)[:, None], jnp.abs(centered), 0)
    size = jax.lax.stop_gradient(jnp.max(counted, initial=0))
    unit = centered / jnp.where(size > 0, size, 1)
    return _Moments(first + more, size, unit, share @ jnp.sum(unit**2, axis=1))


def _rmse(share, x, y, linear):
    """The root of sum share |t - M x|^2, computed in units of the target."""
    size = jnp.where(y.size > 0, y.size, 1)
    gaps = y.unit - (x.size / size) * (x.unit @ linear.T)
    square = share @ jnp.sum(gaps**2, axis=1)
    return size * jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def _scale(covariance, rotation, x, y):
    """tr(S D) / variance, in the units of the points; one where nothing is known."""
    gain = safe_divide(jnp.sum(rotation * covariance), x.variance)
    ratio = safe_divide(y.size, x.size)
    return jnp.where((gain > 0) & (ratio > 0), gain * ratio, 1)


def _ambiguous(spectrum, share, x, y):
    """Whether some turn costs nothing, compared with rounding.

    The two smallest signed singular values cancel; or, in space, one of the clouds is a
    line up to the rounding of coordinates far from the origin.
    """
    eps = jnp.finfo(spectrum.dtype).eps
    rounding = 16 * spectrum.shape[0] * eps * jnp.sqrt(x.variance * y.variance)
    loose = spectrum[-1] + spectrum[-2] <= rounding
    if spectrum.shape[0] == 2:
        return loose
    return loose | _is_line(share, x) | _is_line(share, y)


def _is_line(share, m: _Moments):
    """Whether sum_{i<j} l_i l_j of the eigenvalues of the covariance is rounding."""
    covariance = (share[:, None] * m.unit).T @ m.unit
    products = (m.variance**2 - jnp.sum(covariance**2)) / 2
    eps = jnp.finfo(share.dtype).eps
    far = safe_divide(jnp.max(jnp.abs(m.center)), m.size)
    rounding = 16 * covariance.shape[0] * eps + (4 * eps * far) ** 2
    return products <= rounding * m.variance**2


def _check_pairs(source, target):
    check_shape("source", source, (None, None))
    check_shape("target", target, source.shape)
    if source.shape[1] < 2:
        raise GeometryError(
            message(
                "points must have two coordinates or more",
                f"shape {source.shape}",
                "Pass arrays [n, d]; on a line there is nothing to turn.",
            )
        )
