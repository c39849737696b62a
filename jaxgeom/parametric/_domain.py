"""Where a parameter runs, and what happens at its ends."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, message


class Interval(eqx.Module):
    """The parameter of a curve, or one of the two of a surface: low <= t <= high.

    - `periodic`: the shape at `high` is that at `low`, and goes on there.
    - `twisted`: on the way around, the other parameter of the surface is turned over,
      X(high, v) = X(low, v_low + v_high - v), as on the strip of Moebius.
    - `poles`: at (`low`, `high`) the whole side of the surface is one point.
    - `breaks`: the increasing parameters between the ends where the shape is less
      smooth than elsewhere; quadrature and tessellation put borders there.

    All static. Raises `GeometryError` for ends, flags or breaks that do not fit.
    """

    low: float = eqx.field(static=True, converter=float, default=0.0)
    high: float = eqx.field(static=True, converter=float, default=1.0)
    periodic: bool = eqx.field(static=True, kw_only=True, default=False)
    twisted: bool = eqx.field(static=True, kw_only=True, default=False)
    poles: tuple[bool, bool] = eqx.field(
        static=True, kw_only=True, default=(False, False)
    )
    breaks: tuple[float, ...] = eqx.field(static=True, kw_only=True, default=())

    def __check_init__(self):
        inner = (self.low, *self.breaks, self.high)
        if not (np.isfinite(inner).all() and (np.diff(inner) > 0).all()):
            _refuse("low, breaks and high must be finite and increase", f"{inner}")
        if self.periodic and any(self.poles):
            _refuse("a periodic parameter has no ends", f"poles {self.poles}")
        if self.twisted and not self.periodic:
            _refuse("only a periodic parameter can be twisted", "periodic=False")

    @property
    def length(self) -> float:
        """high - low."""
        return self.high - self.low

    @property
    def pieces(self) -> np.ndarray:
        """The ends and the breaks, in order."""
        return np.array([self.low, *self.breaks, self.high])

    def nodes(self, cells: int) -> np.ndarray:
        """The borders of about `cells` cells, none across a break (host).

        Pieces between breaks are divided evenly; each gets at least one cell. Without
        breaks there are `cells` + 1 equidistant nodes.
        """
        share = np.diff(self.pieces) / self.length * cells
        counts = np.maximum(np.rint(share), 1).astype(int)
        parts = [
            np.linspace(a, b, n, endpoint=False)
            for a, b, n in zip(self.pieces[:-1], self.pieces[1:], counts, strict=True)
        ]
        return np.append(np.concatenate(parts), self.high)


class Domain(eqx.Module):
    """The rectangle of the parameters (u, v) of a surface."""

    u: Interval = Interval()
    v: Interval = Interval()

    def wrap(self, uv: Float[Array, " 2"]) -> Float[Array, " 2"]:
        """Parameters of the domain that name the same place, or the nearest in it.

        Beyond a pole the way goes on along the opposite meridian; periodic parameters
        are taken around; else the ends are not passed.
        """
        u, v = _across_pole(self.u, uv[0], uv[1], self.v)
        v, u = _across_pole(self.v, v, u, self.u)
        u, v = _around(self.u, u, v, self.v)
        v, u = _around(self.v, v, u, self.u)
        return jnp.stack([_clip(self.u, u), _clip(self.v, v)])


def wrap_parameter(interval: Interval, t: Float[Array, ""]) -> Float[Array, ""]:
    """The parameter of a curve taken into its interval."""
    return _clip(interval, _around(interval, t, t, interval)[0])


def _across_pole(interval, t, other, around):
    """t mirrored at the poles of its interval, half a turn later."""
    low, high = interval.poles
    below, above = (t < interval.low) & low, (t > interval.high) & high
    beyond = below | above
    mirrored = 2 * jnp.where(below, interval.low, interval.high) - t
    half = around.length / 2 if around.periodic else 0.0
    return jnp.where(beyond, mirrored, t), jnp.where(beyond, other + half, other)


def _around(interval, t, other, other_interval):
    if not interval.periodic:
        return t, other
    turns = jnp.floor((t - interval.low) / interval.length)
    t = t - turns * interval.length
    if interval.twisted:
        turned = other_interval.low + other_interval.high - other
        other = jnp.where(turns % 2 == 1, turned, other)
    return t, other


def _clip(interval, t):
    return jnp.clip(t, interval.low, interval.high)


def _refuse(must, given):
    raise GeometryError(message(must, given, "Change the Interval."))
