"""B-spline bases: knots and degree, evaluated without a division by zero."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core import GeometryError, message


class SplineBasis(eqx.Module):
    """The B-splines N_0 ... N_(n-1) of a degree p over n + p + 1 knots.

    They live on [knots[p], knots[n]]; there they are not negative and add up to one.
    Beyond it the outermost polynomials go on. Both are static, so that maps between
    bases can be planned on the host, also within jit.

    Raises `GeometryError` for knots that are not finite, decrease, are too few for the
    degree, or are repeated so often that the basis is not continuous.
    """

    knots: tuple[float, ...] = eqx.field(
        static=True, converter=lambda x: tuple(float(k) for k in np.asarray(x).ravel())
    )
    degree: int = eqx.field(static=True)

    def __check_init__(self):
        knots, p = np.array(self.knots), self.degree
        if p < 1:
            _refuse("the degree must be at least 1", f"{p}", "Pass a higher degree.")
        if len(knots) < 2 * p + 2:
            must = f"degree {p} needs at least {2 * p + 2} knots"
            _refuse(must, f"{len(knots)}", "Pass more knots or lower the degree.")
        if not np.isfinite(knots).all():
            _refuse("knots must be finite", f"{self.knots}", "Remove NaN and infinity.")
        if (np.diff(knots) < 0).any():
            first = int(np.argmax(np.diff(knots) < 0))
            given = f"{knots[first]} before {knots[first + 1]} at {first}"
            _refuse("knots must not decrease", given, "Sort them.")
        low, high = knots[p], knots[self.num_control]
        values, counts = np.unique(knots, return_counts=True)
        inner = (low < values) & (values < high)
        if low == high or (counts > np.where(inner, p, p + 1)).any():
            must = f"inner knots may be repeated {p} times, outer ones {p + 1} times"
            given = f"{dict(zip(values.tolist(), counts.tolist(), strict=True))}"
            _refuse(must, given, "Remove repeated knots or split the curve there.")

    @staticmethod
    def clamped(num_control: int, degree: int = 3) -> "SplineBasis":
        """Equidistant knots on [0, 1] whose ends are repeated: ends are met.

        Raises `GeometryError` for a degree of `num_control` or more.
        """
        _check_count(num_control, degree, degree + 1)
        inner = np.linspace(0, 1, num_control - degree + 1)
        return SplineBasis([0.0] * degree + inner.tolist() + [1.0] * degree, degree)

    @staticmethod
    def closed(num_control: int, degree: int = 3) -> "SplineBasis":
        """Equidistant knots, without repetition, for closed curves on [0, 1].

        The first `degree` of the `num_control` + `degree` control points must be
        repeated at the end. Raises `GeometryError` for fewer than `degree` points.
        """
        _check_count(num_control, degree, max(degree, 3))
        steps = np.arange(-degree, num_control + degree + 1)
        return SplineBasis(steps / num_control, degree)

    @property
    def num_control(self) -> int:
        """The number n of functions, that is of control points."""
        return len(self.knots) - self.degree - 1

    @property
    def low(self) -> float:
        """Where the domain begins."""
        return self.knots[self.degree]

    @property
    def high(self) -> float:
        """Where the domain ends."""
        return self.knots[self.num_control]

    @property
    def spans(self) -> np.ndarray:
        """The indices k with knots[k] < knots[k + 1] within the domain."""
        knots = np.array(self.knots)
        inside = np.arange(self.degree, self.num_control)
        return inside[knots[inside] < knots[inside + 1]]

    @property
    def breaks(self) -> tuple[float, ...]:
        """The knots strictly inside the domain, each once."""
        return tuple(self.knots[k] for k in self.spans[1:])

    @property
    def greville(self) -> np.ndarray:
        """The means of `degree` knots: where each control point acts most, about."""
        windows = np.lib.stride_tricks.sliding_window_view(self.knots, self.degree)
        return windows[1:-1].mean(axis=1)

    def values(self, t: Float[Array, ""]) -> Float[Array, " n"]:
        """All N_i(t)."""
        return self.derivatives(t, 0)[0]

    def derivatives(self, t: Float[Array, ""], order: int) -> Float[Array, "r n"]:
        """N_i and its first `order` derivatives at t, rows 0 to `order`.

        From differences of the functions of lower degree (Piegl, Tiller 1997, section
        2.3), right at every knot: there from the right, at the last from the left. The
        values are a triangle of convex combinations.
        """
        first, rows = self.local(t, order)
        return jnp.stack([self.spread(first, row) for row in rows])

    def local(self, t: Float[Array, ""], order: int = 0):
        """The index of the first function that is not zero at t, and rows [r] of lists
        of the p + 1 functions from there on, with their derivatives."""
        p, spans, knots = self.degree, self.spans, np.array(self.knots)
        which = self._which(t, spans, knots)
        # Column by column: gathers of single numbers are faster than of rows.
        pick = lambda column: jnp.asarray(column, t.dtype)[which]
        window = [pick(knots[spans + j]) for j in range(1 - p, p + 1)]
        triangle = [[jnp.ones_like(t)]]
        for d in range(1, p + 1):
            triangle.append(_raised(triangle[-1], window, p, d, t))
        rows = [triangle[p]]
        for k in range(1, order + 1):
            rows.append(_differentiated(triangle, window, p, k, t))
        return jnp.asarray(spans - p, jnp.int32)[which], rows

    def spread(self, first: Int[Array, ""], row: list) -> Float[Array, " n"]:
        """A row of all n functions with the values of `row` from `first` on."""
        places = jnp.arange(self.num_control)
        return sum(jnp.where(places == first + j, x, 0) for j, x in enumerate(row))

    def _which(self, t, spans, knots):
        """The number of the span of t; the outer ones reach to infinity."""
        inner = jnp.asarray(knots[spans[1:]], t.dtype)
        return jnp.searchsorted(inner, t, side="right", method="compare_all")


def _raised(below, window, p, d, t):
    """The functions of degree d from those of degree d - 1 (Cox, de Boor)."""
    share = _shares(below, window, p, d)
    rising = [s * (t - window[p - d + j]) for j, s in enumerate(share)]
    falling = [s * (window[p + j] - t) for j, s in enumerate(share)]
    return _overlaid(rising, falling)


def _differentiated(triangle, window, p, k, t):
    """The k-th derivatives at degree p: k differences from degree p - k."""
    if k > p:
        return [jnp.zeros_like(t)] * (p + 1)
    row = triangle[p - k]
    for d in range(p - k + 1, p + 1):
        share = [d * s for s in _shares(row, window, p, d)]
        row = _overlaid(share, [-s for s in share])
    return row


def _shares(row, window, p, d):
    # Each interval holds the span of t, which is not empty: nothing divides by zero.
    return [x / (window[p + j] - window[p - d + j]) for j, x in enumerate(row)]


def _overlaid(rising, falling):
    zero = jnp.zeros_like(rising[0])
    return [a + b for a, b in zip([zero, *rising], [*falling, zero], strict=True)]


def _check_count(number, degree, least):
    if number < least:
        must = f"degree {degree} needs at least {least} control points"
        _refuse(must, f"{number}", "Pass more points or lower the degree.")


def _refuse(must, given, fix):
    raise GeometryError(message(must, given, fix))
