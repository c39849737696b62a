"""Closed formulas: quadrics, tori, the strips without two sides.

u goes around and v along, so that X_u x X_v points out of the body.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._abstract import AbstractSurface, point, scalar
from ._curves import TURN
from ._domain import Domain, Interval

_ORIGIN = (0.0, 0.0, 0.0)
_AROUND = Interval(0, TURN, periodic=True)
_LATITUDE = Interval(-np.pi / 2, np.pi / 2, poles=(True, True))


class Patch(AbstractSurface):
    """The parallelogram corner + u side + v other, 0 <= u, v <= 1."""

    corner: Float[Array, " 3"] = eqx.field(converter=point)
    side: Float[Array, " 3"] = eqx.field(converter=point)
    other: Float[Array, " 3"] = eqx.field(converter=point)

    def evaluate(self, uv):
        return self.corner + uv[0] * self.side + uv[1] * self.other

    def domain(self):
        return Domain()


class Sphere(AbstractSurface):
    """The sphere of `radius` about `center`: u the longitude, v the latitude."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=point, default=_ORIGIN)

    def evaluate(self, uv):
        return self.center + self.radius * _on_unit_sphere(uv)

    def domain(self):
        return Domain(_AROUND, _LATITUDE)


class Ellipsoid(AbstractSurface):
    """The unit sphere stretched by `radii` [3] along x, y, z, about `center`."""

    radii: Float[Array, " 3"] = eqx.field(converter=point)
    center: Float[Array, " 3"] = eqx.field(converter=point, default=_ORIGIN)

    def evaluate(self, uv):
        return self.center + self.radii * _on_unit_sphere(uv)

    def domain(self):
        return Domain(_AROUND, _LATITUDE)


class Torus(AbstractSurface):
    """A tube of radius `minor` around the circle of radius `major` about z.

    u is the angle around the axis, v the one around the tube, zero outside.
    """

    major: Float[Array, ""] = eqx.field(converter=scalar)
    minor: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=point, default=_ORIGIN)

    def evaluate(self, uv):
        u, v = uv
        reach = self.major + self.minor * jnp.cos(v)
        z = self.minor * jnp.sin(v)
        return self.center + jnp.stack([reach * jnp.cos(u), reach * jnp.sin(u), z])

    def domain(self):
        return Domain(_AROUND, _AROUND)


class Cylinder(AbstractSurface):
    """The side of a cylinder about z, |z| <= height / 2; v from 0 to 1."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    height: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=point, default=_ORIGIN)

    def evaluate(self, uv):
        u, v = uv
        x, y = self.radius * jnp.cos(u), self.radius * jnp.sin(u)
        return self.center + jnp.stack([x, y, self.height * (v - 0.5)])

    def domain(self):
        return Domain(_AROUND, Interval())


class Cone(AbstractSurface):
    """The side of a cone about z: a circle of `radius` about `center`, apex above it.

    v from 0 (the circle) to 1 (the apex, a pole).
    """

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    height: Float[Array, ""] = eqx.field(converter=scalar)
    center: Float[Array, " 3"] = eqx.field(converter=point, default=_ORIGIN)

    def evaluate(self, uv):
        u, v = uv
        reach = self.radius * (1 - v)
        return self.center + jnp.stack(
            [reach * jnp.cos(u), reach * jnp.sin(u), self.height * v]
        )

    def domain(self):
        return Domain(_AROUND, Interval(0, 1, poles=(False, True)))


class MoebiusStrip(AbstractSurface):
    """A strip of half width `half_width` around the circle of `radius`, turned once.

    ((r + w v cos u/2) cos u, (r + w v cos u/2) sin u, w v sin u/2), |v| <= 1. It has
    one side: the normal at u = 2 pi is minus that at u = 0.
    """

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    half_width: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, uv):
        u, v = uv
        across = self.half_width * v
        reach = self.radius + across * jnp.cos(u / 2)
        z = across * jnp.sin(u / 2)
        return jnp.stack([reach * jnp.cos(u), reach * jnp.sin(u), z])

    def domain(self):
        turned = Interval(0, TURN, periodic=True, twisted=True)
        return Domain(turned, Interval(-1, 1))


class KleinBottle(AbstractSurface):
    """A figure of eight carried around the circle of `radius`, turned once.

    With c = cos u/2, s = sin u/2 and (a, b) = `size` (sin v, sin 2v): the point
    ((r + c a - s b) cos u, (r + c a - s b) sin u, s a + c b). It has no boundary and
    one side, and passes through itself.
    """

    radius: Float[Array, ""] = eqx.field(converter=scalar)
    size: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, uv):
        u, v = uv
        c, s = jnp.cos(u / 2), jnp.sin(u / 2)
        a, b = self.size * jnp.sin(v), self.size * jnp.sin(2 * v)
        reach = self.radius + c * a - s * b
        return jnp.stack([reach * jnp.cos(u), reach * jnp.sin(u), s * a + c * b])

    def domain(self):
        turned = Interval(0, TURN, periodic=True, twisted=True)
        return Domain(turned, _AROUND)


def _on_unit_sphere(uv):
    u, v = uv
    return jnp.stack([jnp.cos(v) * jnp.cos(u), jnp.cos(v) * jnp.sin(u), jnp.sin(v)])
