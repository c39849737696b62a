"""The exact signed distance of ellipsoids and ellipses."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_normalize
from ._field import AbstractField
from ._parameters import vector
from ._primitives import distance_about

_NEWTON_STEPS = 12


class ExactEllipsoid(AbstractField):
    """The ellipsoid of `radii` [3] about its center. Exact distance.

    The closest point is c_i = r_i^2 y_i / (t + r_i^2), with t the largest root of
    sum (r_i y_i / (t + r_i^2))^2 = 1, found by Newton's method, which converges from
    one side. `Ellipsoid` is a cheaper bound.

    Source: D. Eberly, Distance from a point to an ellipse, an ellipsoid, or a
    hyperellipsoid, 2013.
    """

    radii: Float[Array, " 3"] = eqx.field(converter=vector("radii"))
    center: Float[Array, " 3"] = eqx.field(
        converter=vector("center"), default=(0.0, 0.0, 0.0)
    )

    def evaluate(self, point):
        return _distance(point - self.center, self.radii)

    def claims(self):
        return distance_about(self.center, self.radii)


class Ellipse(AbstractField):
    """The ellipse of `radii` [2] about its center, as `ExactEllipsoid`. Exact."""

    radii: Float[Array, " 2"] = eqx.field(converter=vector("radii", 2))
    center: Float[Array, " 2"] = eqx.field(
        converter=vector("center", 2), default=(0.0, 0.0)
    )

    def evaluate(self, point):
        return _distance(point - self.center, self.radii)

    def claims(self):
        return distance_about(self.center, self.radii)


def _distance(y, radii):
    """n . (y - r u), with c = r u the closest point and n the normal there.

    The gradient of a distance is that of the gap to a closest point held at the same
    unit vector u (envelope theorem), so the search has none.
    """
    u, n = jax.lax.stop_gradient(_closest(y, radii))
    return jnp.dot(n, y - radii * u)


def _closest(y, radii):
    """The unit vector u = c / r of the closest point, and the outward normal there."""
    least = jnp.min(radii)
    # On a plane of symmetry the closest point is either of two: step off to one side.
    side = jnp.where(y < 0, -1, 1)
    size = jnp.maximum(jnp.abs(y), jnp.finfo(y.dtype).eps * least)
    excess = radii**2 - least**2
    start = jnp.max(radii * size - excess)

    def newton(_, s):
        parts = radii * size / (s + excess)
        value = jnp.sum(parts**2) - 1
        slope = -2 * jnp.sum(parts**2 / (s + excess))
        return s - value / slope

    s = jax.lax.fori_loop(0, _NEWTON_STEPS, newton, start)
    u = safe_normalize(radii * side * size / (s + excess))
    return u, safe_normalize(u / radii)
