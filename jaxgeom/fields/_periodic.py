"""Triply periodic minimal surfaces, as level sets of short trigonometric sums.

With u = 2 pi x / period. Each is a lower bound of the distance by `Conditioned`, with
a bound of its second derivatives: the largest sum of a row of the Hessian, each entry
at its largest (a cos t + b sin t is at most sqrt(a^2 + b^2)).

Source: the level-set approximations of H. G. von Schnering, R. Nesper (1991).
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._claims import IMPLICIT_ONLY, Bounds, Claims
from ._conditioned import Conditioned
from ._field import AbstractField
from ._parameters import scalar


class Periodic(AbstractField):
    """formula(cos u, sin u) - level, u = 2 pi x / period. Implicit only.

    Made by `gyroid` and its like; `slope` is a bound of the gradient in u.
    """

    period: Float[Array, ""] = eqx.field(converter=scalar)
    level: Float[Array, ""] = eqx.field(converter=scalar)
    formula: Callable = eqx.field(static=True)
    slope: float = eqx.field(static=True)

    def evaluate(self, point):
        u = 2 * math.pi * point / self.period
        return self.formula(jnp.cos(u), jnp.sin(u)) - self.level

    def claims(self):
        space = Bounds.everywhere()
        steep = self.slope * 2 * math.pi / self.period
        return Claims(steep, IMPLICIT_ONLY, space, space)


def gyroid(period=1.0, level=0.0) -> Conditioned:
    """sin u cos v + sin v cos w + sin w cos u - level: two mazes that never meet."""
    return _bounded(period, level, _gyroid, math.sqrt(6), 2 + math.sqrt(2))


def schwarz_p(period=1.0, level=0.0) -> Conditioned:
    """cos u + cos v + cos w - level."""
    return _bounded(period, level, _primitive, math.sqrt(3), 1.0)


def schwarz_d(period=1.0, level=0.0) -> Conditioned:
    """cos u cos v cos w - sin u sin v sin w - level."""
    return _bounded(period, level, _diamond, math.sqrt(3), 3.0)


def neovius(period=1.0, level=0.0) -> Conditioned:
    """3 (cos u + cos v + cos w) + 4 cos u cos v cos w - level."""
    return _bounded(period, level, _neovius, 7 * math.sqrt(3), 15.0)


def _gyroid(c, s):
    return s[0] * c[1] + s[1] * c[2] + s[2] * c[0]


def _primitive(c, s):
    return jnp.sum(c)


def _diamond(c, s):
    return c[0] * c[1] * c[2] - s[0] * s[1] * s[2]


def _neovius(c, s):
    return 3 * jnp.sum(c) + 4 * c[0] * c[1] * c[2]


def _bounded(period, level, formula, slope, bend) -> Conditioned:
    surface = Periodic(period, level, formula, slope)
    return Conditioned(surface, bend * (2 * math.pi / surface.period) ** 2)
