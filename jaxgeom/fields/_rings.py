"""Frames, rings, links, and bodies that end nowhere."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_norm
from ._claims import Bounds, Claims, Trust
from ._field import AbstractField
from ._parameters import scalar, vector
from ._primitives import distance_about, orthant

_ORIGIN = (0.0, 0.0, 0.0)


class BoxFrame(AbstractField):
    """The twelve edges of the box of half extents [3], as beams `width` wide inside it.

    Exact outside, a lower bound inside (the union of three beams for every corner).
    """

    half_extents: Float[Array, " 3"] = eqx.field(converter=vector("half_extents"))
    width: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=vector("center"), default=_ORIGIN)

    def evaluate(self, point):
        outer = jnp.abs(point - self.center) - self.half_extents
        # |. + w/2| - w/2 is the distance along one axis to the beams across it.
        inner = jnp.abs(outer + self.width / 2) - self.width / 2
        beams = [orthant(inner.at[d].set(outer[d])) for d in range(3)]
        return jnp.min(jnp.stack(beams))

    def claims(self):
        part = distance_about(self.center, self.half_extents)
        return part.trusted(Trust.EXACT, Trust.BOUND)


class RoundedCylinder(AbstractField):
    """The capped cylinder along z with edges rounded to `edge`, which its radius and
    half height include. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    half_height: Float[Array, ""] = eqx.field(converter=scalar)
    edge: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        side = safe_norm(point[:2]) - self.radius
        cap = jnp.abs(point[2]) - self.half_height
        return orthant(jnp.stack([side, cap]) + self.edge) - self.edge

    def claims(self):
        reach = jnp.stack([self.radius, self.radius, self.half_height])
        return distance_about(jnp.zeros_like(reach), reach)


class InfiniteCylinder(AbstractField):
    """|x_xy| - radius: the cylinder along z without ends. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return safe_norm(point[:2]) - self.radius

    def claims(self):
        endless = jnp.asarray(jnp.inf, self.radius.dtype)
        reach = jnp.stack([self.radius, self.radius, endless])
        return distance_about(jnp.zeros_like(reach), reach)


class InfiniteCone(AbstractField):
    """The points within `half_angle` (radians, less than pi/2) of the positive z-axis.

    r cos a - z sin a beside the flank, |x| behind the apex. Exact distance.
    """

    half_angle: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        r, z = safe_norm(point[:2]), point[2]
        s, c = jnp.sin(self.half_angle), jnp.cos(self.half_angle)
        return jnp.where(r * s + z * c > 0, r * c - z * s, safe_norm(point))

    def claims(self):
        low = jnp.array([-jnp.inf, -jnp.inf, 0.0], self.half_angle.dtype)
        return Claims.distance(Bounds.of(low, jnp.full_like(low, jnp.inf)))


class CappedTorus(AbstractField):
    """The part of the torus within `half_angle` (radians) of the positive y-axis, with
    round ends: the points within `minor` of an arc of radius `major` in z = 0.

    Exact distance for minor <= major.
    """

    major: Float[Array, ""] = eqx.field(converter=scalar)
    minor: Float[Array, ""] = eqx.field(converter=scalar)
    half_angle: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        arc = arc_distance(point[:2], self.major, self.half_angle)
        return safe_norm(jnp.append(arc, point[2:])) - self.minor

    def claims(self):
        return distance_about(*_arc_box(self, 3))


class Arc(AbstractField):
    """The points of the plane within `half_width` of an arc of `radius` about the
    origin, within `half_angle` (radians) of the positive y-axis. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    half_width: Float[Array, ""] = eqx.field(converter=scalar)
    half_angle: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        arc = arc_distance(point, self.radius, self.half_angle)
        return safe_norm(arc) - self.half_width

    def claims(self):
        return distance_about(jnp.zeros(2), self.radius + self.half_width)


class CutHollowSphere(AbstractField):
    """The shell of `radius` and `thickness`, without what is above z = height, with a
    round rim. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    height: Float[Array, ""] = eqx.field(converter=scalar)
    thickness: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        # The arc opens upwards: its middle is the lowest point.
        flat = jnp.stack([safe_norm(point[:2]), -point[2]])
        half_angle = math.pi - jnp.arccos(self.height / self.radius)
        arc = arc_distance(flat, self.radius, half_angle)
        return safe_norm(arc) - self.thickness / 2

    def claims(self):
        reach = self.radius + self.thickness / 2
        return distance_about(jnp.zeros(3), reach)


class Link(AbstractField):
    """The chain link: a torus of radii `major` and `minor` in the plane x = 0, pulled
    apart along z by 2 `half_length`. Exact distance for minor <= major."""

    half_length: Float[Array, ""] = eqx.field(converter=scalar)
    major: Float[Array, ""] = eqx.field(converter=scalar)
    minor: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        z = jnp.maximum(jnp.abs(point[2]) - self.half_length, 0)
        ring = safe_norm(jnp.stack([point[1], z])) - self.major
        return safe_norm(jnp.stack([ring, point[0]])) - self.minor

    def claims(self):
        wide = self.major + self.minor
        reach = jnp.stack([self.minor, wide, wide + self.half_length])
        return distance_about(jnp.zeros_like(reach), reach)


def arc_distance(point, radius, half_angle) -> Float[Array, " 2"]:
    """A vector [2] as long as the distance from a point of the plane to the arc."""
    s, c = jnp.sin(half_angle), jnp.cos(half_angle)
    x, y = jnp.abs(point[0]), point[1]
    beside = x * c - y * s > 0
    across = safe_norm(point) - radius
    on_arc = jnp.stack([across, jnp.zeros_like(across)])
    to_end = jnp.stack([x - radius * s, y - radius * c])
    return jnp.where(beside, to_end, on_arc)


def _arc_box(torus, dimension):
    """Center and reach of the box of a capped torus: that of the whole torus."""
    outer = torus.major + torus.minor
    reach = jnp.stack([outer, outer, torus.minor])
    return jnp.zeros(dimension, reach.dtype), reach
