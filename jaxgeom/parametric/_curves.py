"""Lines, circles, helices, knots and chains of segments."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, message
from ._abstract import AbstractCurve, point, scalar, sized
from ._domain import Interval

TURN = 2 * np.pi
_ORIGIN = (0.0, 0.0, 0.0)


class Line(AbstractCurve):
    """The segment (1 - t) start + t end, 0 <= t <= 1."""

    start: Float[Array, " 3"] = eqx.field(converter=point)
    end: Float[Array, " 3"] = eqx.field(converter=point)

    def evaluate(self, t):
        return (1 - t) * self.start + t * self.end

    def interval(self):
        return Interval()


class Circle(AbstractCurve):
    """The circle of `radius` about `center` in the plane of x and y, t the angle."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=point, default=_ORIGIN)

    def evaluate(self, t):
        unit = jnp.stack([jnp.cos(t), jnp.sin(t), jnp.zeros_like(t)])
        return self.center + self.radius * unit

    def interval(self):
        return Interval(0, TURN, periodic=True)


class Arc(AbstractCurve):
    """A part of a circle about `center` in the plane of x and z, to be revolved.

    From the angle `start` to `end`, counted from x towards z, as 0 <= t <= 1.
    """

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    start: Float[Array, ""] = eqx.field(converter=scalar)
    end: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=point, default=_ORIGIN)

    def evaluate(self, t):
        angle = (1 - t) * self.start + t * self.end
        unit = jnp.stack([jnp.cos(angle), jnp.zeros_like(angle), jnp.sin(angle)])
        return self.center + self.radius * unit

    def interval(self):
        return Interval()


class Helix(AbstractCurve):
    """(r cos t, r sin t, pitch t / 2 pi): it rises by `pitch` on each of `turns`."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    pitch: Float[Array, ""] = eqx.field(converter=scalar)
    turns: float = eqx.field(static=True, converter=float, default=1.0)

    def evaluate(self, t):
        x, y = self.radius * jnp.cos(t), self.radius * jnp.sin(t)
        return jnp.stack([x, y, self.pitch * t / TURN])

    def interval(self):
        return Interval(0, TURN * self.turns)


class TorusKnot(AbstractCurve):
    """The knot (p, q) on a torus: p times around its axis, q times around its tube.

    ((R + r cos q t) cos p t, (R + r cos q t) sin p t, r sin q t) with R = `major` and
    r = `minor`, 0 <= t <= 2 pi. One closed curve if p and q have no common divisor.
    """

    major: Float[Array, ""] = eqx.field(converter=scalar)
    minor: Float[Array, ""] = eqx.field(converter=scalar)
    p: int = eqx.field(static=True, default=2)
    q: int = eqx.field(static=True, default=3)

    def evaluate(self, t):
        reach = self.major + self.minor * jnp.cos(self.q * t)
        x, y = reach * jnp.cos(self.p * t), reach * jnp.sin(self.p * t)
        return jnp.stack([x, y, self.minor * jnp.sin(self.q * t)])

    def interval(self):
        return Interval(0, TURN, periodic=True)


class Polyline(AbstractCurve):
    """Straight segments through `vertices` [k, 3]; the i-th is reached at t = i.

    `closed` joins the last to the first. At a vertex the derivative is that of the
    segment behind it. Raises `GeometryError` for fewer than two vertices (three if
    closed).
    """

    vertices: Float[Array, "k 3"] = eqx.field(converter=sized("vertices", None, 3))
    closed: bool = eqx.field(static=True, kw_only=True, default=False)

    def __check_init__(self):
        least = 3 if self.closed else 2
        if self.vertices.shape[0] < least:
            must = f"a polyline with closed={self.closed} needs {least} vertices"
            given = f"{self.vertices.shape[0]}"
            raise GeometryError(message(must, given, "Pass more vertices."))

    def evaluate(self, t):
        k = self.vertices.shape[0]
        segments = self._segments()
        # Beyond the ends the outer segments go on straight.
        index = jnp.clip(jnp.floor(t), 0, segments - 1).astype(jnp.int32)
        start, end = self.vertices[index], self.vertices[(index + 1) % k]
        return start + (t - index) * (end - start)

    def interval(self):
        segments = self._segments()
        breaks = tuple(float(i) for i in range(1, segments))
        return Interval(0, segments, periodic=self.closed, breaks=breaks)

    def _segments(self):
        return self.vertices.shape[0] - (0 if self.closed else 1)
