"""The exact signed distance of ellipsoids, ellipses and parabolas."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_normalize
from ._claims import Bounds, Claims
from ._field import AbstractField
from ._parameters import scalar, vector
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


class Parabola(AbstractField):
    """The region y >= `coefficient` x^2 of the plane, coefficient > 0. Exact distance.

    The closest point (s, k s^2) has s of the sign of x, and t = |s| is the positive
    root of 2 k^2 t^3 + (1 - 2 k y) t = |x|, found by Newton's method from above, where
    the cubic is convex.
    """

    coefficient: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        s = jax.lax.stop_gradient(_foot_on_parabola(self.coefficient, *point))
        foot = jnp.stack([s, self.coefficient * s**2])
        # Outward, held at the same s as in `_distance`.
        slope = 2 * jax.lax.stop_gradient(self.coefficient) * s
        normal = safe_normalize(jnp.stack([slope, -jnp.ones_like(s)]))
        return jnp.dot(normal, point - foot)

    def claims(self):
        low = jnp.array([-jnp.inf, 0.0], self.coefficient.dtype)
        return Claims.distance(Bounds.of(low, jnp.full_like(low, jnp.inf)))


def _foot_on_parabola(k, x, y):
    """The abscissa of the closest point."""
    far, linear = jnp.abs(x), 1 - 2 * k * y
    above = jnp.cbrt(far / (2 * k**2)) + jnp.sqrt(jnp.maximum(-linear, 0) / 2) / k
    start = jnp.where(
        linear > 0, jnp.minimum(above, far / jnp.where(linear > 0, linear, 1)), above
    )

    def newton(_, t):
        slope = 6 * k**2 * t**2 + linear
        value = 2 * k**2 * t**3 + linear * t - far
        return t - jnp.where(slope > 0, value / jnp.where(slope > 0, slope, 1), 0)

    t = jax.lax.fori_loop(0, _NEWTON_STEPS, newton, start)
    return jnp.where(x < 0, -t, t)


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
