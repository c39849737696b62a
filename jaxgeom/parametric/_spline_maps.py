"""Knot insertion, degree elevation, reversal: linear maps between B-spline bases.

The control points of a spline are values of its blossom at consecutive knots, so that
the control points over any finer basis are blossoms at its knots (Ramshaw 1989;
Goldman, Lyche 1993). Planned on the host; the maps act on homogeneous control points.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, message
from ._splines import SplineBasis


class SplineMap(eqx.Module):
    """The control points over `basis` are `matrix` [r, n] times those over another."""

    matrix: np.ndarray
    basis: SplineBasis

    def __call__(self, points: Float[Array, "n *d"]) -> Float[Array, "r *d"]:
        """The new control points of (homogeneous) control points [n, ...]."""
        return jnp.tensordot(jnp.asarray(self.matrix, points.dtype), points, 1)

    def then(self, other: "SplineMap") -> "SplineMap":
        """This map and after it `other`, as one."""
        return SplineMap(other.matrix @ self.matrix, other.basis)


def insertion(basis: SplineBasis, knots) -> SplineMap:
    """The same curve with more knots: any number at once, repeated or not.

    Raises `GeometryError` for knots outside the domain and for too many repetitions.
    Source: W. Boehm, Inserting new knots into B-spline curves, 1980.
    """
    added = np.atleast_1d(np.asarray(knots, float))
    if added.size and not ((basis.low <= added).all() and (added <= basis.high).all()):
        must = f"new knots must lie in [{basis.low}, {basis.high}]"
        given = f"{added.tolist()}"
        raise GeometryError(message(must, given, "Remove those outside."))
    finer = SplineBasis(np.sort([*basis.knots, *added]), basis.degree)
    arguments = _windows(finer, basis.degree)
    return SplineMap(_blossoms(basis, arguments, finer.greville), finer)


def elevation(basis: SplineBasis, times: int = 1) -> SplineMap:
    """The same curve with a degree `times` higher; every knot is repeated as much more.

    The new blossom is the mean of the old one over the arguments left out (Prautzsch
    1984). Raises `GeometryError` for a negative number.
    """
    if times < 0:
        must = "the degree can be elevated, not lowered"
        raise GeometryError(message(must, f"times={times}", "Fit a new curve instead."))
    out = SplineMap(np.eye(basis.num_control), basis)
    for _ in range(times):
        out = out.then(_elevated_once(out.basis))
    return out


def reversal(basis: SplineBasis) -> SplineMap:
    """The same curve run through backwards, on the same domain."""
    # Rounding must not leave the ends of the domain nor the repetitions.
    exact = {k: basis.low + basis.high - k for k in set(basis.knots)}
    exact |= {basis.low: basis.high, basis.high: basis.low}
    turned = [exact[k] for k in basis.knots[::-1]]
    matrix = np.eye(basis.num_control)[::-1]
    return SplineMap(matrix, SplineBasis(turned, basis.degree))


def splitting(basis: SplineBasis, at: float) -> tuple[SplineMap, SplineMap]:
    """The parts of a curve before and after the parameter `at`, clamped there.

    Raises `GeometryError` unless `at` lies strictly inside the domain.
    """
    if not basis.low < at < basis.high:
        must = f"a curve is split strictly inside ({basis.low}, {basis.high})"
        raise GeometryError(message(must, f"{at}", "Pass a parameter inside."))
    p = basis.degree
    whole = insertion(basis, [at] * (p - basis.knots.count(at)))
    knots = whole.basis.knots
    first = knots.index(at)
    before = SplineBasis([*knots[: first + p], at], p)
    after = SplineBasis([at, *knots[first:]], p)
    return (
        SplineMap(whole.matrix[: before.num_control], before),
        SplineMap(whole.matrix[-after.num_control :], after),
    )


def bezier_pieces(basis: SplineBasis) -> Float[np.ndarray, "s p+1 n"]:
    """The matrices from the control points to the Bezier points of every span."""
    p, spans = basis.degree, basis.spans
    knots = np.array(basis.knots)
    low, high = knots[spans], knots[spans + 1]
    # Blossoms at j times the high and p - j times the low end of the span.
    take_high = np.arange(p) >= p - np.arange(p + 1)[:, None]
    arguments = np.where(take_high, high[:, None, None], low[:, None, None])
    middles = np.repeat((low + high) / 2, p + 1)
    rows = _blossoms(basis, arguments.reshape(-1, p), middles)
    return rows.reshape(len(spans), p + 1, basis.num_control)


def _elevated_once(basis):
    p = basis.degree
    values = np.array(basis.knots)
    extra = np.unique(values[(basis.low <= values) & (values <= basis.high)])
    outside = np.unique(values[(values < basis.low) | (values > basis.high)])
    finer = SplineBasis(np.sort([*values, *extra, *outside]), p + 1)
    arguments = _windows(finer, p + 1)
    left_out = [np.delete(arguments, k, axis=1) for k in range(p + 1)]
    means = [_blossoms(basis, a, finer.greville) for a in left_out]
    return SplineMap(np.mean(means, axis=0), finer)


def _windows(basis, size):
    """The `size` knots [n, size] that belong to every control point."""
    windows = np.lib.stride_tricks.sliding_window_view(basis.knots, size)
    return windows[1 : basis.num_control + 1]


def _blossoms(basis, arguments, places):
    """The blossoms at arguments [m, p] of the polynomials at places [m], as rows [m, n]
    of factors of the control points."""
    p, spans = basis.degree, basis.spans
    knots = np.array(basis.knots)
    inner = knots[spans[1:]]
    span = spans[np.searchsorted(inner, places, side="right")]
    row = np.ones((len(places), 1))
    for d in range(1, p + 1):
        t = arguments[:, d - 1 : d]
        high = knots[span[:, None] + np.arange(1, d + 1)]
        low = knots[span[:, None] + np.arange(1 - d, 1)]
        share = row / (high - low)
        pad = np.zeros((len(places), 1))
        rising = np.hstack([pad, share * (t - low)])
        row = rising + np.hstack([share * (high - t), pad])
    out = np.zeros((len(places), basis.num_control))
    columns = span[:, None] - p + np.arange(p + 1)
    np.put_along_axis(out, columns, row, axis=1)
    return out
