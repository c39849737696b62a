"""Metaballs: bodies around points that attract each other."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_norm
from ._claims import LOWER_BOUND, Bounds, Claims
from ._field import AbstractField
from ._parameters import array, scalar


class Metaballs(AbstractField):
    """level - sum_i strength_i w(|x - center_i| / radius_i), w(t) = (1 - t^2)^3, t < 1.

    Twice differentiable; zero influence beyond the radii. A lower bound, over the
    Lipschitz constant: the sum of |strength| / radius times the steepest slope of w,
    96 sqrt(5) / 125. The level must be positive.

    Source: G. Wyvill, C. McPheeters, B. Wyvill, Data structure for soft objects, 1986
    (with a shorter polynomial).
    """

    centers: Float[Array, "n 3"] = eqx.field(converter=array("centers", None, 3))
    radii: Float[Array, " n"] = eqx.field(converter=array("radii", None))
    strengths: Float[Array, " n"] = eqx.field(converter=array("strengths", None))
    level: Float[Array, ""] = eqx.field(converter=scalar, default=0.5)

    def evaluate(self, point):
        gap = (point - self.centers) / self.radii[:, None]
        near = jnp.maximum(1 - jnp.sum(gap * gap, axis=1), 0)
        return self.level - jnp.sum(self.strengths * near**3)

    def claims(self):
        # w' = -6 t (1 - t^2)^2 is steepest at t = 1 / sqrt(5).
        slope = 96 * math.sqrt(5) / 125
        steepest = slope * jnp.sum(jnp.abs(self.strengths) / self.radii)
        reach = self.radii[:, None]
        low = jnp.min(self.centers - reach, axis=0)
        high = jnp.max(self.centers + reach, axis=0)
        box = Bounds.of(low, high, 0.0)
        return Claims(steepest, LOWER_BOUND, box, Bounds.everywhere())


class PointCloudField(AbstractField):
    """The points within `radius` of a cloud of points [n, 3]: min_i |x - p_i| - radius.

    Exact outside, a lower bound inside. O(n) for each point.
    """

    points: Float[Array, "n 3"] = eqx.field(converter=array("points", None, 3))
    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return jnp.min(safe_norm(point - self.points)) - self.radius

    def claims(self):
        low = jnp.min(self.points, axis=0) - self.radius
        high = jnp.max(self.points, axis=0) + self.radius
        part = Claims.distance(Bounds.of(low, high))
        return part.trusted(part.exactness.outside, LOWER_BOUND.inside)
