"""Surfaces made of curves and of other surfaces: revolved, ruled, offset."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._abstract import AbstractCurve, AbstractSurface, scalar
from ._curves import TURN
from ._domain import Domain, Interval
from ._queries import normal


class Revolution(AbstractSurface):
    """A curve turned about the z axis: u the angle, v the parameter of the curve.

    (x cos u - y sin u, x sin u + y cos u, z) for the point (x, y, z) of the curve. With
    a curve in the half plane y = 0, x > 0 that rises, the normal points outwards.

    - `poles`: whether the curve (begins, ends) on the axis; static.
    """

    curve: AbstractCurve
    poles: tuple[bool, bool] = eqx.field(
        static=True, kw_only=True, default=(False, False)
    )

    def evaluate(self, uv):
        u, v = uv
        x, y, z = self.curve(v)
        c, s = jnp.cos(u), jnp.sin(u)
        return jnp.stack([c * x - s * y, s * x + c * y, z])

    def domain(self):
        along = self.curve.interval()
        v = Interval(
            along.low,
            along.high,
            periodic=along.periodic,
            poles=self.poles,
            breaks=along.breaks,
        )
        return Domain(Interval(0, TURN, periodic=True), v)


class Ruled(AbstractSurface):
    """The segments from `first`(u) to `second`(u), 0 <= v <= 1.

    The interval of the second curve is stretched over that of the first; periodic in u
    where both curves are.
    """

    first: AbstractCurve
    second: AbstractCurve

    def evaluate(self, uv):
        u, v = uv
        a, b = self.first.interval(), self.second.interval()
        other = b.low + (u - a.low) * (b.length / a.length)
        return (1 - v) * self.first(u) + v * self.second(other)

    def domain(self):
        a, b = self.first.interval(), self.second.interval()
        moved = [a.low + (x - b.low) * (a.length / b.length) for x in b.breaks]
        u = Interval(
            a.low,
            a.high,
            periodic=a.periodic and b.periodic,
            breaks=_merged(a.breaks, moved, a.length),
        )
        return Domain(u, Interval())


class Offset(AbstractSurface):
    """The points of a surface moved by `distance` along its unit normal: X + d n.

    Where d exceeds a radius of curvature on the side of the normal, the surface folds
    back. Poles stay poles, as the normal has a limit there.
    """

    surface: AbstractSurface
    distance: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, uv):
        return self.surface(uv) + self.distance * normal(self.surface, uv)

    def domain(self):
        return self.surface.domain()


def _merged(first, second, length):
    """All breaks in order; those equal up to rounding count once."""
    both = np.sort([*first, *second])
    apart = np.diff(both, prepend=-np.inf) > 64 * np.finfo(float).eps * length
    return tuple(float(x) for x in both[apart])
