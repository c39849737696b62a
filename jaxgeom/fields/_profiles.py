"""Shapes of the plane with straight edges; exact distances, to extrude and revolve."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._field import AbstractField
from ._outlines import AbstractOutlined, Outline
from ._parameters import array, scalar, vector
from ._primitives import distance_about, orthant

_ORIGIN = (0.0, 0.0)


class Rectangle(AbstractField):
    """The rectangle of half extents [2] about its center. Exact distance."""

    half_extents: Float[Array, " 2"] = eqx.field(converter=vector("half_extents", 2))
    center: Float[Array, " 2"] = eqx.field(
        converter=vector("center", 2), default=_ORIGIN
    )

    def evaluate(self, point):
        return orthant(jnp.abs(point - self.center) - self.half_extents)

    def claims(self):
        return distance_about(self.center, self.half_extents)


class RoundedRectangle(AbstractField):
    """The rectangle with corners rounded to `radius`, which its half extents include.

    Exact distance.
    """

    half_extents: Float[Array, " 2"] = eqx.field(converter=vector("half_extents", 2))
    radius: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 2"] = eqx.field(
        converter=vector("center", 2), default=_ORIGIN
    )

    def evaluate(self, point):
        core = self.half_extents - self.radius
        return orthant(jnp.abs(point - self.center) - core) - self.radius

    def claims(self):
        return distance_about(self.center, self.half_extents)


class ChamferedRectangle(AbstractOutlined):
    """The rectangle of half extents [2] whose corners are cut off at 45 degrees, by
    `chamfer` along both sides; less than both half extents. Exact distance."""

    half_extents: Float[Array, " 2"] = eqx.field(converter=vector("half_extents", 2))
    chamfer: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        (w, h), c = self.half_extents, self.chamfer
        right = [(w - c, -h), (w, c - h), (w, h - c), (w - c, h)]
        return Outline.of([*right, *((-x, -y) for x, y in right)])


class Stairs(AbstractOutlined):
    """`count` steps (static) up to the right from the origin, each `step` [2] wide and
    high, and what is below them. Exact distance."""

    step: Float[Array, " 2"] = eqx.field(converter=vector("step", 2))
    count: int = eqx.field(static=True)

    def outline(self):
        (w, h), n = self.step, self.count
        zero = jnp.zeros_like(w)
        corners = [(zero, zero), (n * w, zero)]
        for i in range(n, 0, -1):
            corners += [(i * w, i * h), ((i - 1) * w, i * h)]
        return Outline.of(corners)


class Polygon(AbstractOutlined):
    """The region inside a closed chain of vertices [n, 2] that does not cross itself.

    Clockwise or counter-clockwise. Exact distance, O(n) for each point.
    """

    vertices: Float[Array, "n 2"] = eqx.field(converter=array("vertices", None, 2))

    def outline(self):
        x, y = self.vertices.T
        area = jnp.sum(x * jnp.roll(y, -1) - y * jnp.roll(x, -1))
        counter = jax.lax.stop_gradient(area) >= 0
        return Outline(jnp.where(counter, self.vertices, self.vertices[::-1]))


class Triangle(AbstractOutlined):
    """The triangle with corners first, second, third [2]. Exact distance."""

    first: Float[Array, " 2"] = eqx.field(converter=vector("first", 2))
    second: Float[Array, " 2"] = eqx.field(converter=vector("second", 2))
    third: Float[Array, " 2"] = eqx.field(converter=vector("third", 2))

    def outline(self):
        return Polygon(jnp.stack([self.first, self.second, self.third])).outline()


class Trapezoid(AbstractOutlined):
    """The symmetric trapezoid from y = -half_height, where it is 2 `bottom` wide, to
    y = half_height, where it is 2 `top` wide. Exact distance."""

    bottom: Float[Array, ""] = eqx.field(converter=scalar)
    top: Float[Array, ""] = eqx.field(converter=scalar)
    half_height: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        b, t, h = self.bottom, self.top, self.half_height
        return Outline.of([(-b, -h), (b, -h), (t, h), (-t, h)])


class Parallelogram(AbstractOutlined):
    """The rectangle of half extents [2] whose upper side is moved by `skew` along x and
    its lower side by as much back. Exact distance."""

    half_extents: Float[Array, " 2"] = eqx.field(converter=vector("half_extents", 2))
    skew: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        (w, h), s = self.half_extents, self.skew
        return Outline.of([(-w - s, -h), (w - s, -h), (w + s, h), (-w + s, h)])


class Rhombus(AbstractOutlined):
    """The rhombus with corners on the axes at `half_diagonals` [2]. Exact distance."""

    half_diagonals: Float[Array, " 2"] = eqx.field(
        converter=vector("half_diagonals", 2)
    )

    def outline(self):
        w, h = self.half_diagonals
        zero = jnp.zeros_like(w)
        return Outline.of([(w, zero), (zero, h), (-w, zero), (zero, -h)])


class RegularPolygon(AbstractOutlined):
    """The polygon of `sides` equal sides (static) in the circle of `radius`.

    One corner lies on the positive y-axis. Exact distance.
    """

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    sides: int = eqx.field(static=True)

    def outline(self):
        return Outline(self.radius * _directions(self.sides, self.radius.dtype))


class Star(AbstractOutlined):
    """The star of `tips` points (static) on the circle of radius `outer`, with notches
    on that of radius `inner`. Exact distance.

    tips=5, inner=0.382 outer is the pentagram; tips=6, inner=0.577 outer the hexagram.
    """

    outer: Float[Array, ""] = eqx.field(converter=scalar)
    inner: Float[Array, ""] = eqx.field(converter=scalar)
    tips: int = eqx.field(static=True, default=5)

    def outline(self):
        radii = jnp.stack([self.outer, self.inner] * self.tips)[:, None]
        return Outline(radii * _directions(2 * self.tips, self.outer.dtype))


class Cross(AbstractOutlined):
    """The plus sign with arms of length `reach` and half width `half_width`.

    Exact distance.
    """

    reach: Float[Array, ""] = eqx.field(converter=scalar)
    half_width: Float[Array, ""] = eqx.field(converter=scalar)

    def outline(self):
        r, w = self.reach, self.half_width
        quarter = [(r, -w), (r, w), (w, w)]
        corners = list(quarter)
        for _ in range(3):
            quarter = [(-y, x) for x, y in quarter]
            corners += quarter
        return Outline.of(corners)


class Gear(AbstractOutlined):
    """The wheel of `teeth` trapezoids (static) between the radii `root` and `tip`.

    At the root a tooth takes 3/5 of its share of the circle, at the tip 3/10. Exact
    distance.
    """

    root: Float[Array, ""] = eqx.field(converter=scalar)
    tip: Float[Array, ""] = eqx.field(converter=scalar)
    teeth: int = eqx.field(static=True, default=12)

    def outline(self):
        step = 2 * math.pi / self.teeth
        within = np.array([-0.3, -0.15, 0.15, 0.3]) * step
        angles = (np.arange(self.teeth)[:, None] * step + within).reshape(-1)
        radii = jnp.stack([self.root, self.tip, self.tip, self.root] * self.teeth)
        turns = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        return Outline(radii[:, None] * jnp.asarray(turns, radii.dtype))


def _directions(count, dtype):
    """Unit vectors [count, 2], counter-clockwise, the first along y."""
    angles = math.pi / 2 + 2 * math.pi * np.arange(count) / count
    return jnp.asarray(np.stack([np.cos(angles), np.sin(angles)], axis=1), dtype)
