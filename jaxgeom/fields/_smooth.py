"""Smooth Booleans: creases filled to a depth that is known.

smin(a, b) = min(a, b) - k w(|a - b| / k), k = width / 6, with a fillet w that falls
from w(0) = 1 to 0 with slope between -1 and 0. So min - k <= smin <= min, and the two
partial derivatives lie in [0, 1] and sum to 1: smin keeps the Lipschitz constant, and a
lower bound of the distance stays one.

Source: I. Quilez, Smooth minimum (2013, 2024), normalised to the same depth.
"""

import functools
import math
from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide
from ._claims import Claims
from ._field import AbstractField, claims_of_all
from ._parameters import scalar


class AbstractFillet(eqx.Module):
    """The shape of a filled crease."""

    @abstractmethod
    def weight(self, gap: Float[Array, ""]) -> Float[Array, ""]:
        """w(|a - b| / k): 1 at 0, falling to 0 with a slope between -1 and 0."""


class CubicFillet(AbstractFillet):
    """w = h^3, h = max(1 - t/6, 0). Twice differentiable; ends where |a - b| = 6k."""

    def weight(self, gap):
        return jnp.maximum(1 - gap / 6, 0) ** 3


class QuadraticFillet(AbstractFillet):
    """w = h^2, h = max(1 - t/4, 0). Once differentiable; ends where |a - b| = 4k."""

    def weight(self, gap):
        return jnp.maximum(1 - gap / 4, 0) ** 2


class QuarticFillet(AbstractFillet):
    """w = h^3 (4 - h) / 3, h = max(1 - 3t/16, 0). Ends where |a - b| = 16k/3."""

    def weight(self, gap):
        h = jnp.maximum(1 - 3 * gap / 16, 0)
        return h**3 * (4 - h) / 3


class CircularFillet(AbstractFillet):
    """w = c (1 + h - sqrt(1 + 2h - h^2)) / 2 with h = max(1 - t/c, 0).

    c = 1/(1 - sqrt(1/2)). Between two walls at right angles the crease is a circle.
    """

    def weight(self, gap):
        c = 1 / (1 - math.sqrt(0.5))
        h = jnp.maximum(1 - gap / c, 0)
        return c * (1 + h - jnp.sqrt(1 + 2 * h - h * h)) / 2


class ExponentialFillet(AbstractFillet):
    """w = log2(1 + 2^-t): smin = -k log2(2^(-a/k) + 2^(-b/k)). Smooth; associative."""

    def weight(self, gap):
        return jnp.log1p(jnp.exp2(-gap)) / math.log(2)


class RootFillet(AbstractFillet):
    """w = sqrt(1 + t^2/4) - t/2. Smooth.

    smin = (a + b - sqrt((a - b)^2 + 4k^2)) / 2.
    """

    def weight(self, gap):
        # The difference of two large numbers, without cancellation.
        return 1 / (jnp.sqrt(1 + gap * gap / 4) + gap / 2)


class SigmoidFillet(AbstractFillet):
    """w = t / (e^t - 1). Smooth."""

    def weight(self, gap):
        apart = gap > jnp.finfo(gap.dtype).eps
        t = jnp.where(apart, gap, 1)
        return jnp.where(apart, t * jnp.exp(-t) / -jnp.expm1(-t), 1 - gap / 2)


class SmoothUnion(AbstractField):
    """The union with its crease filled; a lower bound.

    min(a, b) - k w(|a - b| / k), k = width / 6: between k below the union and the
    union. With the cubic fillet it differs from the union only where |a - b| < width.
    Width 0 is the plain union.
    """

    first: Callable
    second: Callable
    width: Float[Array, ""] = eqx.field(converter=scalar)
    fillet: AbstractFillet = CubicFillet()

    def evaluate(self, point):
        return _smooth_min(self, self.first(point), self.second(point))

    def claims(self):
        a, b = claims_of_all(self.first, self.second)
        return a.union(b).filled(self.width / 6)


class SmoothIntersection(AbstractField):
    """-smin(-a, -b): the intersection with its edge rounded off; a lower bound.

    Between the intersection and k = width / 6 above it.
    """

    first: Callable
    second: Callable
    width: Float[Array, ""] = eqx.field(converter=scalar)
    fillet: AbstractFillet = CubicFillet()

    def evaluate(self, point):
        return -_smooth_min(self, -self.first(point), -self.second(point))

    def claims(self):
        a, b = claims_of_all(self.first, self.second)
        joined = a.complement().union(b.complement())
        return joined.filled(self.width / 6).complement()


class UnionOfMany(AbstractField):
    """The union of any number of fields; with a width, its creases are filled.

    -k log2 sum_i 2^(-f_i / k), k = width / 6: between k log2 n below min f_i and it,
    whatever the order. A lower bound; exact outside where all are and width is 0.

    **Arguments:**

    - `bodies`: a tuple of fields, or ONE field whose leaves have a leading axis (as
      from `jax.vmap(Sphere)(radii, centers)`), which is evaluated by `vmap`.
    """

    bodies: Callable | tuple[Callable, ...]
    width: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)

    def evaluate(self, point):
        values = values_of(self.bodies, point)
        k = self.width / 6
        deepest = jnp.min(values)
        drop = jax.nn.logsumexp(-math.log(2) * safe_divide(values - deepest, k))
        return deepest - k * drop / math.log(2)

    def claims(self):
        return union_claims(self.bodies, self.width / 6)


def values_of(bodies, point) -> Float[Array, " n"]:
    """The values of a tuple of fields, or of one field with a leading axis."""
    if isinstance(bodies, tuple):
        return jnp.stack([body(point) for body in bodies])
    return jax.vmap(lambda body: body(point))(bodies)


def union_claims(bodies, depth) -> Claims:
    """Those of the union of many, filled by up to depth log2 n."""
    if isinstance(bodies, tuple):
        parts = claims_of_all(*bodies)
        whole = functools.reduce(Claims.union, parts)
        return whole.filled(depth * math.log2(len(parts)))
    parts = jax.vmap(lambda body: body.claims())(bodies)
    count = parts.lipschitz.shape[0]
    return parts.union_along_axis().filled(depth * math.log2(count))


def _smooth_min(node, a, b):
    k = node.width / 6
    # Not |a - b|, whose derivative at a tie is 1: here it is 0, and smin's is 1/2 each.
    least = jnp.minimum(a, b)
    weight = node.fillet.weight(safe_divide(jnp.maximum(a, b) - least, k))
    return least - k * weight
