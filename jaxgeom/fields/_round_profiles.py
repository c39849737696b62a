"""Shapes of the plane with circular edges; exact distances, to extrude and revolve."""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_norm
from ._field import AbstractField
from ._outlines import AbstractOutlined, Outline
from ._parameters import scalar, vector
from ._primitives import distance_about

_ORIGIN = (0.0, 0.0)


class Circle(AbstractField):
    """|x - center| - radius, the disk. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 2"] = eqx.field(
        converter=vector("center", 2), default=_ORIGIN
    )

    def evaluate(self, point):
        return safe_norm(point - self.center) - self.radius

    def claims(self):
        return distance_about(self.center, self.radius)


class Ring(AbstractField):
    """||x| - radius| - width/2: what lies between two circles. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    width: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return jnp.abs(safe_norm(point) - self.radius) - self.width / 2

    def claims(self):
        reach = self.radius + self.width / 2
        return distance_about(jnp.zeros(2, reach.dtype), reach)


class Pie(AbstractOutlined):
    """The sector of the disk of `radius` within `half_angle` (radians, less than pi) of
    the positive y-axis. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    half_angle: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        x = self.radius * jnp.sin(self.half_angle)
        y = self.radius * jnp.cos(self.half_angle)
        zero = jnp.zeros_like(x)
        bulge = jnp.tan(self.half_angle / 2)
        return Outline.of([(zero, zero), (x, y), (-x, y)], [zero, bulge, zero])


class CutDisk(AbstractOutlined):
    """The part y <= height of the disk of `radius`; |height| < radius.

    Exact distance.
    """

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    height: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        half = jnp.arccos(self.height / self.radius)
        x = self.radius * jnp.sin(half)
        bulge = jnp.tan((math.pi - half) / 2)
        corners = [(x, self.height), (-x, self.height)]
        return Outline.of(corners, [jnp.zeros_like(x), bulge])


class Horseshoe(AbstractOutlined):
    """The part of the ring of `radius` and `width` that is more than `half_angle`
    (radians) from the positive y-axis, with flat ends. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    width: Float[Array, ""] = eqx.field(converter=scalar)
    half_angle: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        s, c = jnp.sin(self.half_angle), jnp.cos(self.half_angle)
        out, inn = self.radius + self.width / 2, self.radius - self.width / 2
        bulge = jnp.tan((math.pi - self.half_angle) / 2)
        zero = jnp.zeros_like(s)
        corners = [
            (-out * s, out * c),
            (out * s, out * c),
            (inn * s, inn * c),
            (-inn * s, inn * c),
        ]
        return Outline.of(corners, [bulge, zero, -bulge, zero])


class Vesica(AbstractOutlined):
    """What two disks of `radius` with centers at x = -offset and x = offset share;
    0 < offset < radius. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    offset: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        half = jnp.arccos(self.offset / self.radius)
        y = self.radius * jnp.sin(half)
        zero, bulge = jnp.zeros_like(y), jnp.tan(half / 2)
        return Outline.of([(zero, -y), (zero, y)], [bulge, bulge])


class Moon(AbstractOutlined):
    """The disk of radius `outer` about the origin without the disk of radius `inner`
    about (0, distance); the circles must cross. Exact distance."""

    outer: Float[Array, ""] = eqx.field(converter=scalar)
    inner: Float[Array, ""] = eqx.field(converter=scalar)
    distance: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        a, b, d = self.outer, self.inner, self.distance
        y = (a**2 - b**2 + d**2) / (2 * d)
        out = math.pi - jnp.arccos(y / a)
        bite = jnp.arccos((d - y) / b)
        x = b * jnp.sin(bite)
        return Outline.of([(-x, y), (x, y)], [jnp.tan(out / 2), -jnp.tan(bite / 2)])


class UnevenCapsule(AbstractOutlined):
    """The convex hull of the disk of radius `bottom` about the origin and the disk of
    radius `top` about (0, distance), |bottom - top| < distance. Exact distance."""

    bottom: Float[Array, ""] = eqx.field(converter=scalar)
    top: Float[Array, ""] = eqx.field(converter=scalar)
    distance: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        b, t, d = self.bottom, self.top, self.distance
        lean = jnp.arcsin((b - t) / d)
        s, c = jnp.sin(lean), jnp.cos(lean)
        corners = [(-b * c, b * s), (b * c, b * s), (t * c, d + t * s)]
        corners.append((-t * c, d + t * s))
        zero = jnp.zeros_like(s)
        down, up = (jnp.tan((math.pi + x) / 4) for x in (2 * lean, -2 * lean))
        return Outline.of(corners, [down, zero, up, zero])


class Egg(AbstractOutlined):
    """The egg with a half disk of radius `bottom` below y = 0, a cap of radius `top`
    above and sides of radius 2 bottom between; top < bottom. Exact distance."""

    bottom: Float[Array, ""] = eqx.field(converter=scalar)
    top: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        b, t = self.bottom, self.top
        # The sides' centers are (-b, 0) and (b, 0), the cap's is (0, y).
        y = jnp.sqrt((2 * b - t) ** 2 - b**2)
        turn = jnp.arctan2(y, b)
        corner = (t * jnp.cos(turn), y + t * jnp.sin(turn))
        corners = [(-b, jnp.zeros_like(b)), (b, jnp.zeros_like(b)), corner]
        corners.append((-corner[0], corner[1]))
        side = jnp.tan(turn / 4)
        cap = jnp.tan((math.pi - 2 * turn) / 4)
        return Outline.of(corners, [jnp.ones_like(b), side, cap, side])


class RoundedCross(AbstractField):
    """The star of four tips on the axes at `tips` [2], with arcs for sides that touch
    the x-axis; tips[1] is at most tips[0]. Exact distance.

    In the first quadrant the arc has its center over the tip on the x-axis. At this
    tip the region is a cusp, which an outline of arcs cannot tell apart.
    """

    tips: Float[Array, " 2"] = eqx.field(converter=vector("tips", 2))

    def evaluate(self, point):
        (x, y), p = self.tips, jnp.abs(point)
        radius = (x**2 + y**2) / (2 * y)
        on_arc = (p[0] < x) & (p[1] < y + p[0] * (radius - y) / x)
        zero = jnp.zeros_like(x)
        flank = radius - safe_norm(p - jnp.stack([x, radius]))
        ends = jnp.stack([p - jnp.stack([x, zero]), p - jnp.stack([zero, y])])
        return jnp.where(on_arc, flank, jnp.min(safe_norm(ends)))

    def claims(self):
        return distance_about(jnp.zeros_like(self.tips), self.tips)


class Tunnel(AbstractOutlined):
    """A rectangle of half width `radius` from y = -depth to 0 under a half disk.

    Exact distance.
    """

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    depth: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        r, d = self.radius, self.depth
        zero, one = jnp.zeros_like(r), jnp.ones_like(r)
        corners = [(-r, -d), (r, -d), (r, zero), (-r, zero)]
        return Outline.of(corners, [zero, zero, one, zero])


class Heart(AbstractOutlined):
    """The square on its corner with half disks on its two upper sides, `size` from the
    lower corner (at the origin) to the notch. Exact distance."""

    size: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        h = self.size / 2
        zero, one = jnp.zeros_like(h), jnp.ones_like(h)
        corners = [(zero, zero), (h, h), (zero, 2 * h), (-h, h)]
        return Outline.of(corners, [zero, one, one, zero])
