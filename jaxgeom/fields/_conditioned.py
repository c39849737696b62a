"""A smooth function made a lower bound of the distance, by a bound of its curvature."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide, safe_norm
from ._claims import LOWER_BOUND, Bounds, Claims
from ._field import AbstractField, claims
from ._parameters import scalar, vector
from ._primitives import orthant

_EVERYWHERE = (jnp.inf, jnp.inf, jnp.inf)


class Conditioned(AbstractField):
    """2 f / (g + sqrt(g^2 + 2 M |f|)), g = |grad f|: a lower bound of the distance.

    M is a bound of the second derivatives of f (of the norm of its Hessian). The value
    d solves |f| = g d + M d^2 / 2, so no zero of f is nearer than d (Taylor's theorem);
    its own gradient is (grad f - d grad g) / (g + M d), of length at most 1 since |grad
    g| <= M. At a regular point of the surface it has slope 1, as a distance has.

    Where M holds in the box from `low` to `high` only, the body is cut off there: max
    of the box and of the value at the nearest point of the box.

    Source: the first-order bound is that of G. Taubin, Distance approximations for
    rasterizing implicit curves, 1994; the Lipschitz constant follows as above.
    """

    body: Callable
    curvature: Float[Array, ""] = eqx.field(converter=scalar)
    low: Float[Array, " 3"] = eqx.field(
        converter=vector("low"), default=(-jnp.inf, -jnp.inf, -jnp.inf)
    )
    high: Float[Array, " 3"] = eqx.field(converter=vector("high"), default=_EVERYWHERE)

    def evaluate(self, point):
        held = jnp.clip(point, self.low, self.high)
        f, slope = jax.value_and_grad(lambda x: self.body(x))(held)
        g = safe_norm(slope)
        square = g * g + 2 * self.curvature * jnp.abs(f)
        positive = square > 0
        root = jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)
        inner = safe_divide(2 * f, g + root)
        cut = orthant(jnp.maximum(self.low - point, point - self.high))
        return jnp.maximum(inner, cut)

    def claims(self):
        part = claims(self.body).inside
        space = Bounds.everywhere()
        box = Bounds.of(self.low, self.high, 1.0)
        inside = Bounds(part.low, part.high, jnp.zeros(())).meet(box)
        ends = jnp.all(jnp.isinf(part.low) & jnp.isinf(part.high))
        growth = jnp.where(ends, box.growth, inside.growth)
        kept = Bounds(inside.low, inside.high, growth)
        return Claims(jnp.ones(()), LOWER_BOUND, kept, space)
