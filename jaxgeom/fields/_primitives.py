"""Bodies with closed formulas, with gradients that are finite everywhere.

After the collection of I. Quilez ("distance functions"), with safe norms: the usual
formulas have a NaN gradient at centers, on axes and inside boxes.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide, safe_norm, safe_normalize
from ._claims import Bounds, Claims
from ._field import AbstractField
from ._parameters import scalar, vector

_ORIGIN = (0.0, 0.0, 0.0)


class Sphere(AbstractField):
    """|x - center| - radius. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=vector("center"), default=_ORIGIN)

    def evaluate(self, point):
        return safe_norm(point - self.center) - self.radius

    def claims(self):
        return distance_about(self.center, self.radius)


class Box(AbstractField):
    """The box of half extents [3] about its center. Exact distance."""

    half_extents: Float[Array, " 3"] = eqx.field(converter=vector("half_extents"))
    center: Float[Array, " 3"] = eqx.field(converter=vector("center"), default=_ORIGIN)

    def evaluate(self, point):
        return orthant(jnp.abs(point - self.center) - self.half_extents)

    def claims(self):
        return distance_about(self.center, self.half_extents)


class RoundedBox(AbstractField):
    """The box with edges rounded to `radius`, which its half extents include.

    Exact distance.
    """

    half_extents: Float[Array, " 3"] = eqx.field(converter=vector("half_extents"))
    radius: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=vector("center"), default=_ORIGIN)

    def evaluate(self, point):
        core = self.half_extents - self.radius
        return orthant(jnp.abs(point - self.center) - core) - self.radius

    def claims(self):
        return distance_about(self.center, self.half_extents)


class Torus(AbstractField):
    """The ring of radius `major` in the plane z = 0 about its center, tube `minor`.

    ||x - c|_xy - major, z| - minor. Exact distance for major >= minor.
    """

    major: Float[Array, ""] = eqx.field(converter=scalar)
    minor: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=vector("center"), default=_ORIGIN)

    def evaluate(self, point):
        p = point - self.center
        ring = jnp.stack([safe_norm(p[:2]) - self.major, p[2]])
        return safe_norm(ring) - self.minor

    def claims(self):
        outer = self.major + self.minor
        reach = jnp.stack([outer, outer, self.minor])
        return distance_about(self.center, reach)


class Capsule(AbstractField):
    """The points within `radius` of the segment from start to end. Exact distance."""

    start: Float[Array, " 3"] = eqx.field(converter=vector("start"))
    end: Float[Array, " 3"] = eqx.field(converter=vector("end"))
    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        axis, p = self.end - self.start, point - self.start
        along = jnp.clip(safe_divide(jnp.dot(p, axis), jnp.dot(axis, axis)), 0, 1)
        return safe_norm(p - along * axis) - self.radius

    def claims(self):
        low = jnp.minimum(self.start, self.end) - self.radius
        high = jnp.maximum(self.start, self.end) + self.radius
        return Claims.distance(Bounds.of(low, high))


class Cylinder(AbstractField):
    """The capped cylinder along z, |z| <= half_height about its center. Exact."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    half_height: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=vector("center"), default=_ORIGIN)

    def evaluate(self, point):
        p = point - self.center
        side, cap = safe_norm(p[:2]) - self.radius, jnp.abs(p[2]) - self.half_height
        return orthant(jnp.stack([side, cap]))

    def claims(self):
        reach = jnp.stack([self.radius, self.radius, self.half_height])
        return distance_about(self.center, reach)


class Ellipsoid(AbstractField):
    """min(radii) (|(x - center) / radii| - 1). A lower bound of the distance."""

    radii: Float[Array, " 3"] = eqx.field(converter=vector("radii"))
    center: Float[Array, " 3"] = eqx.field(converter=vector("center"), default=_ORIGIN)

    def evaluate(self, point):
        stretched = safe_norm((point - self.center) / self.radii)
        return jnp.min(self.radii) * (stretched - 1)

    def claims(self):
        low, high = self.center - self.radii, self.center + self.radii
        # |u| - 1 >= max |u_i| - 1 >= gap / radius, and a gap has three parts.
        growth = jnp.min(self.radii) / jnp.max(self.radii) / math.sqrt(3)
        return Claims.bound(Bounds.of(low, high, growth))


class Plane(AbstractField):
    """n . x - offset, n = normal / |normal|: the half space below. Exact distance."""

    normal: Float[Array, " 3"] = eqx.field(converter=vector("normal"))
    offset: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)

    def evaluate(self, point):
        return jnp.dot(point, safe_normalize(self.normal)) - self.offset

    def claims(self):
        return Claims.distance(Bounds.everywhere())


def distance_about(center, reach) -> Claims:
    """The claims of the distance of a body within `reach` (a number or [d]) of a center
    along each axis."""
    return Claims.distance(Bounds.of(center - reach, center + reach))


def orthant(q):
    """The signed distance to the set where all q <= 0: |max(q, 0)| or max(q)."""
    deepest = jnp.max(q)
    # One branch each, not their sum, which has half the gradient on the surface.
    return jnp.where(deepest > 0, safe_norm(jnp.maximum(q, 0)), deepest)
