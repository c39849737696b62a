"""What a field promises: how steep it is, how exact, and where its body lies."""

import dataclasses
import enum
import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Trust(enum.IntEnum):
    """What |f(x)| says about the distance from x to the surface, on one side of it.

    - `IMPLICIT`: nothing; only the sign and the zero set mean something.
    - `BOUND`: |f(x)| / L is at most the distance, L the Lipschitz constant.
    - `EXACT`: |f(x)| is the distance.
    """

    IMPLICIT = 0
    BOUND = 1
    EXACT = 2


class Exactness(eqx.Module):
    """How far a field can be trusted outside and inside its body."""

    outside: Trust = eqx.field(static=True)
    inside: Trust = eqx.field(static=True)

    def complement(self) -> "Exactness":
        """That of -f."""
        return Exactness(self.inside, self.outside)

    def at_most(self, outside: Trust, inside: Trust) -> "Exactness":
        """The weaker of this and the given trust, on each side."""
        return Exactness(min(self.outside, outside), min(self.inside, inside))


DISTANCE = Exactness(Trust.EXACT, Trust.EXACT)
LOWER_BOUND = Exactness(Trust.BOUND, Trust.BOUND)
IMPLICIT_ONLY = Exactness(Trust.IMPLICIT, Trust.IMPLICIT)


class Bounds(eqx.Module):
    """An axis-aligned box from `low` [d] to `high` [d], possibly infinite.

    `growth` is a number g with |f(x)| >= g |x - box| outside the box: how sure it is
    that the body grown by an offset t lies in the box grown by t / g. It is infinite
    where nothing lies outside the box, and zero where nothing is known.
    """

    low: Float[Array, " d"]
    high: Float[Array, " d"]
    growth: Float[Array, ""]

    @staticmethod
    def of(low, high, growth=1.0) -> "Bounds":
        """The box between two corners."""
        return Bounds(jnp.asarray(low), jnp.asarray(high), strong(growth))

    @staticmethod
    def everywhere(dimension: int = 3) -> "Bounds":
        """The box without ends."""
        ends = jnp.full(dimension, jnp.inf, float)
        return Bounds(-ends, ends, strong(jnp.inf))

    def hull(self, other: "Bounds") -> "Bounds":
        """The smallest box around both."""
        low, high = _min(self.low, other.low), _max(self.high, other.high)
        return Bounds(low, high, _min(self.growth, other.growth))

    def meet(self, other: "Bounds") -> "Bounds":
        """What both boxes share; low > high where they are apart."""
        low, high = _max(self.low, other.low), _min(self.high, other.high)
        # |max(u, v)| <= sqrt(2) max(|u|, |v|) for the gaps u, v to the two boxes.
        growth = _min(self.growth, other.growth)
        vacuous = jnp.isinf(self.growth) | jnp.isinf(other.growth)
        return Bounds(low, high, jnp.where(vacuous, growth, growth / math.sqrt(2)))

    def grown(self, offset) -> "Bounds":
        """The box of {f <= offset}; unchanged for a negative offset."""
        positive = offset > 0
        margin = jnp.where(positive, offset, 1) / self.growth
        margin = jnp.where(positive, margin, 0)
        return Bounds(self.low - margin, self.high + margin, self.growth)

    def padded(self, margin) -> "Bounds":
        """The box with `margin` (a number or [d]) more on each side."""
        return Bounds(self.low - margin, self.high + margin, self.growth)

    def image(self, transform, growth_kept=1.0) -> "Bounds":
        """The box around the image under a transform."""
        linear, shift = transform.linear(), transform.shift()
        ends = [_product(linear, x) for x in (self.low, self.high)]
        low = jnp.sum(_min(*ends), axis=1) + shift
        high = jnp.sum(_max(*ends), axis=1) + shift
        return Bounds(low, high, self.growth * growth_kept)

    def is_finite(self) -> Array:
        """Whether all six ends are."""
        return jnp.all(jnp.isfinite(self.low) & jnp.isfinite(self.high))


class Claims(eqx.Module):
    """What a field promises; derived for combinations from those of their parts.

    - `lipschitz`: L with |f(x) - f(y)| <= L |x - y|; infinite where there is none, NaN
      where it is not known.
    - `exactness`: what |f| says about distances.
    - `inside`, `outside`: boxes of the points with f <= 0 and with f >= 0.
    """

    lipschitz: Float[Array, ""]
    exactness: Exactness
    inside: Bounds
    outside: Bounds

    @staticmethod
    def distance(inside: Bounds) -> "Claims":
        """Those of the signed distance of a body in a box."""
        outside = Bounds.everywhere(inside.low.shape[0])
        return Claims(strong(1.0), DISTANCE, inside, outside)

    @staticmethod
    def bound(inside: Bounds, lipschitz=1.0) -> "Claims":
        """Those of a field that, over its Lipschitz constant, is a lower bound."""
        outside = Bounds.everywhere(inside.low.shape[0])
        return Claims(strong(lipschitz), LOWER_BOUND, inside, outside)

    @staticmethod
    def unknown(dimension: int = 3) -> "Claims":
        """Those of a function of which nothing is known."""
        space = Bounds.everywhere(dimension)
        return Claims(strong(jnp.nan), IMPLICIT_ONLY, space, space)

    @property
    def bounds(self) -> Bounds:
        """The box of the surface."""
        return self.inside.meet(self.outside)

    def complement(self) -> "Claims":
        """Those of -f."""
        swapped = self.exactness.complement()
        return Claims(self.lipschitz, swapped, self.outside, self.inside)

    def union(self, other: "Claims") -> "Claims":
        """Those of min(f, g): exact outside only, where both are."""
        weaker = self.exactness.at_most(
            other.exactness.outside, min(other.exactness.inside, Trust.BOUND)
        )
        return Claims(
            _max(self.lipschitz, other.lipschitz),
            weaker,
            self.inside.hull(other.inside),
            self.outside.meet(other.outside),
        )

    def union_along_axis(self) -> "Claims":
        """Those of the union of many, whose claims lie along a leading axis."""
        inside, outside = self.inside, self.outside
        weaker = self.exactness.at_most(Trust.EXACT, Trust.BOUND)
        hull = Bounds(
            jnp.min(inside.low, axis=0),
            jnp.max(inside.high, axis=0),
            jnp.min(inside.growth),
        )
        # As in `meet`, with a gap to one of many boxes along each axis.
        shared = Bounds(
            jnp.max(outside.low, axis=0),
            jnp.min(outside.high, axis=0),
            jnp.min(outside.growth) / math.sqrt(self.outside.low.shape[-1]),
        )
        return Claims(jnp.max(self.lipschitz), weaker, hull, shared)

    def intersection(self, other: "Claims") -> "Claims":
        """Those of max(f, g): exact inside only, where both are."""
        return self.complement().union(other.complement()).complement()

    def filled(self, depth) -> "Claims":
        """Those of a function between f - depth and f with the same slope."""
        return self.weakened(inside=self.inside.grown(depth))

    def offset(self, distance) -> "Claims":
        """Those of f - distance."""
        inside, outside = self.inside.grown(distance), self.outside.grown(-distance)
        return self.weakened(inside=inside, outside=outside)

    def trusted(self, outside: Trust, inside: Trust) -> "Claims":
        """The same with no more than the given trust on each side."""
        return self.replaced(exactness=self.exactness.at_most(outside, inside))

    def weakened(self, **changes) -> "Claims":
        """With no more trust than a lower bound, and the changes given."""
        return self.trusted(Trust.BOUND, Trust.BOUND).replaced(**changes)

    def replaced(self, **changes) -> "Claims":
        """With other values of the named attributes."""
        return dataclasses.replace(self, **changes)

    @property
    def dimension(self) -> int:
        """That of the space."""
        return self.inside.low.shape[-1]


def strong(x) -> Array:
    """A number as an array whose type does not depend on its neighbors in a formula."""
    return x if isinstance(x, jax.Array) else jnp.asarray(x, float)


def _product(matrix, x):
    """M_ij x_j, where 0 times an infinite end is 0."""
    zero = matrix == 0
    return jnp.where(zero, 0, matrix * jnp.where(zero, 1, x[None]))


_min, _max = jnp.minimum, jnp.maximum
