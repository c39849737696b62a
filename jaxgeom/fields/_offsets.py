"""Bodies grown, rounded, hollowed and moved."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..transforms import Affine
from ._claims import Claims, Exactness, Trust
from ._field import AbstractField, claims
from ._parameters import scalar
from ._stretch import smallest_stretch


class Offset(AbstractField):
    """a - distance: the body grown by `distance`, shrunk where it is negative.

    A lower bound. Growing an exact distance stays exact outside (see `Rounded`), and
    shrinking one stays exact inside.
    """

    body: Callable
    distance: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return self.body(point) - self.distance

    def claims(self):
        return claims(self.body).offset(self.distance)


class Rounded(AbstractField):
    """a - radius, radius >= 0: the body grown, with its convex edges rounded.

    As exact outside as its part; a lower bound inside.
    """

    body: Callable
    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return self.body(point) - self.radius

    def claims(self):
        part = claims(self.body)
        kept = part.trusted(Trust.EXACT, Trust.BOUND).exactness
        return part.offset(self.radius).replaced(exactness=kept)


class Shell(AbstractField):
    """|a| - thickness/2: the wall around the surface.

    Outside of the wall as exact as its part on both sides; a lower bound within.
    """

    body: Callable
    thickness: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return jnp.abs(self.body(point)) - self.thickness / 2

    def claims(self):
        part, half = claims(self.body), self.thickness / 2
        trust = min(part.exactness.outside, part.exactness.inside)
        inside = part.inside.grown(half).meet(part.outside.grown(half))
        kept = Exactness(trust, min(trust, Trust.BOUND))
        return Claims.bound(inside, part.lipschitz).replaced(exactness=kept)


class Transformed(AbstractField):
    """s a(T^-1 x): the image of a body under T = `world_from_field`.

    As exact as its part for `Rigid` and `Similarity`. A lower bound for `Affine`: s is
    then a smooth lower estimate of how little T stretches (4 % below it at most).
    """

    body: Callable
    world_from_field: eqx.Module

    def evaluate(self, point):
        inside = self.world_from_field.inverse().points(point)
        return smallest_stretch(self.world_from_field) * self.body(inside)

    def claims(self):
        move = self.world_from_field
        part = claims(self.body, dimension=move.shift().shape[0])
        kept = smallest_stretch(move) * smallest_stretch(move.inverse())
        inside, outside = (x.image(move, kept) for x in (part.inside, part.outside))
        least = Trust.BOUND if isinstance(move, Affine) else Trust.EXACT
        return part.trusted(least, least).replaced(inside=inside, outside=outside)
