"""From the plane to space: extrusion, lofts and bodies of revolution."""

import math
from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_norm
from ._claims import Bounds, Claims, Trust
from ._field import AbstractField, claims
from ._outlines import Outline, outline_bounds, outline_distance
from ._parameters import scalar
from ._primitives import orthant
from ._profiles import RegularPolygon, Trapezoid
from ._round_profiles import CutDisk, Moon, Pie, UnevenCapsule, Vesica


class Extruded(AbstractField):
    """The profile in the xy-plane, thickened to |z| <= half_height.

    With a = profile(x, y) and b = |z| - half_height: |max((a, b), 0)| outside and
    max(a, b) inside. As exact as its profile.
    """

    profile: Callable
    half_height: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        cap = jnp.abs(point[2]) - self.half_height
        return orthant(jnp.stack([self.profile(point[:2]), cap]))

    def claims(self):
        part = claims(self.profile, dimension=2)
        inside = part.inside
        low = jnp.append(inside.low, -self.half_height)
        high = jnp.append(inside.high, self.half_height)
        # A gap to the box has a part in the plane and a part along z.
        growth = jnp.minimum(inside.growth, 1) / math.sqrt(2)
        exact = part.exactness.outside == Trust.EXACT
        return Claims(
            jnp.maximum(part.lipschitz, 1),
            part.exactness,
            Bounds.of(low, high, jnp.ones_like(growth) if exact else growth),
            Bounds.everywhere(),
        )


class Revolved(AbstractField):
    """The profile, turned about the z-axis: min of profile(+-r - offset, z), r = |xy|.

    The profile's x points away from the axis, its y along z. As exact outside as its
    profile; inside a lower bound, for a profile that crosses the axis may be nearer to
    a border that the turning has swallowed.
    """

    profile: Callable
    offset: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)

    def evaluate(self, point):
        r = safe_norm(point[:2])
        at = lambda x: self.profile(jnp.stack([x - self.offset, point[2]]))
        return jnp.minimum(at(r), at(-r))

    def claims(self):
        part = claims(self.profile, dimension=2).trusted(Trust.EXACT, Trust.BOUND)
        return part.replaced(
            inside=_turned(part.inside, self.offset), outside=Bounds.everywhere()
        )


class Lofted(AbstractField):
    """The profile `bottom` at z = -half_height, turning into `top` at z = half_height.

    The two values are mixed linearly in z. A lower bound once divided by its Lipschitz
    constant, which is infinite where a profile's box is.
    """

    bottom: Callable
    top: Callable
    half_height: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        t = jnp.clip(point[2] / (2 * self.half_height) + 0.5, 0, 1)
        # Beyond the box of both profiles the values differ without bound: stay in it.
        box = self._box()
        spot = jnp.clip(point[:2], box.low, box.high)
        side = (1 - t) * self.bottom(spot) + t * self.top(spot)
        side = side + safe_norm(point[:2] - spot)
        return orthant(jnp.stack([side, jnp.abs(point[2]) - self.half_height]))

    def claims(self):
        a, b = (claims(x, dimension=2) for x in (self.bottom, self.top))
        box, half = self._box(), self.half_height
        # Along z the side changes by |top - bottom| / height, at most this in the box:
        differ = (a.lipschitz + b.lipschitz) * safe_norm(box.high - box.low)
        slope = jnp.maximum(a.lipschitz, b.lipschitz) + 1
        steep = jnp.sqrt(slope**2 + (differ / (2 * half)) ** 2)
        low, high = jnp.append(box.low, -half), jnp.append(box.high, half)
        weaker = a.union(b).weakened().exactness
        return Claims(
            jnp.maximum(steep, 1),
            weaker,
            Bounds.of(low, high, 1 / math.sqrt(2)),
            Bounds.everywhere(),
        )

    def _box(self):
        a, b = (claims(x, dimension=2) for x in (self.bottom, self.top))
        return a.inside.hull(b.inside)


class AbstractTurned(AbstractField):
    """A body of revolution about the z-axis whose section is an outline. Exact."""

    @abstractmethod
    def section(self) -> Outline:
        """The border of the section with a plane through the axis: both halves."""

    def evaluate(self, point):
        flat = jnp.stack([safe_norm(point[:2]), point[2]])
        return outline_distance(self.section(), flat)

    def claims(self):
        return Claims.distance(_turned(outline_bounds(self.section()), 0))


class Cone(AbstractTurned):
    """The cone on the disk of `radius` in z = 0, with its apex at z = `height`.

    Exact distance.
    """

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    height: Float[Array, ""] = eqx.field(converter=scalar)

    def section(self):
        r, h = self.radius, self.height
        zero = jnp.zeros_like(r)
        return Outline.of([(-r, zero), (r, zero), (zero, h)])


class CappedCone(AbstractTurned):
    """The cone of radius `bottom` at z = -half_height and `top` at z = half_height.

    Exact distance.
    """

    bottom: Float[Array, ""] = eqx.field(converter=scalar)
    top: Float[Array, ""] = eqx.field(converter=scalar)
    half_height: Float[Array, ""] = eqx.field(converter=scalar)

    def section(self):
        return Trapezoid(self.bottom, self.top, self.half_height).outline()


class RoundCone(AbstractTurned):
    """The convex hull of the ball of radius `bottom` about the origin and the ball of
    radius `top` about (0, 0, distance), |bottom - top| < distance. Exact distance."""

    bottom: Float[Array, ""] = eqx.field(converter=scalar)
    top: Float[Array, ""] = eqx.field(converter=scalar)
    distance: Float[Array, ""] = eqx.field(converter=scalar)

    def section(self):
        return UnevenCapsule(self.bottom, self.top, self.distance).outline()


class CutSphere(AbstractTurned):
    """The part z <= height of the ball of `radius`, |height| < radius. Exact."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    height: Float[Array, ""] = eqx.field(converter=scalar)

    def section(self):
        return CutDisk(self.radius, self.height).outline()


class DeathStar(AbstractTurned):
    """The ball of radius `outer` without the ball of radius `inner` about (0, 0,
    distance); the spheres must cross. Exact distance."""

    outer: Float[Array, ""] = eqx.field(converter=scalar)
    inner: Float[Array, ""] = eqx.field(converter=scalar)
    distance: Float[Array, ""] = eqx.field(converter=scalar)

    def section(self):
        return Moon(self.outer, self.inner, self.distance).outline()


class Spindle(AbstractTurned):
    """An arc of radius `radius`, turned about its chord: `offset` is the distance from
    the axis to the arc's center, 0 < offset < radius. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    offset: Float[Array, ""] = eqx.field(converter=scalar)

    def section(self):
        return Vesica(self.radius, self.offset).outline()


class SolidAngle(AbstractTurned):
    """The part of the ball of `radius` within `half_angle` (radians, less than pi) of
    the positive z-axis. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    half_angle: Float[Array, ""] = eqx.field(converter=scalar)

    def section(self):
        return Pie(self.radius, self.half_angle).outline()


class Prism(AbstractField):
    """The regular polygon of `sides` (static) in the circle of `radius`, |z| <=
    half_height: triangular, hexagonal, ... Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    half_height: Float[Array, ""] = eqx.field(converter=scalar)
    sides: int = eqx.field(static=True, default=6)

    def evaluate(self, point):
        return self._extruded().evaluate(point)

    def claims(self):
        return self._extruded().claims()

    def _extruded(self):
        return Extruded(RegularPolygon(self.radius, self.sides), self.half_height)


def _turned(bounds: Bounds, offset) -> Bounds:
    """The box of a plane box (away from the axis, along it) turned about the z-axis."""
    ends = jnp.stack([bounds.low[0], bounds.high[0]]) + offset
    reach = jnp.max(jnp.abs(ends))
    low = jnp.stack([-reach, -reach, bounds.low[1]])
    high = jnp.stack([reach, reach, bounds.high[1]])
    return Bounds(low, high, bounds.growth)
