"""Space bent, twisted, tapered and pulled apart before a body is looked up.

A deformed field is f(q(x)), so its Lipschitz constant is that of f times the largest
stretch of q. Twists and tapers stretch more the farther from the axis: points beyond
the body's box are first moved to its nearest point, which stretches nothing, and the
distance they were moved is added. Where the body's box has no end, neither has the
constant.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide, safe_norm
from ._claims import Bounds, Claims
from ._field import AbstractField, claims
from ._parameters import scalar, vector


class Elongated(AbstractField):
    """f(x - clip(x, -h, h)): the body cut at the planes through the origin and pulled
    apart by 2 h, with straight pieces between.

    A lower bound; exact outside where the body is exact and symmetric in those planes.
    """

    body: Callable
    half_extents: Float[Array, " 3"] = eqx.field(converter=vector("half_extents"))

    def evaluate(self, point):
        h = self.half_extents
        return self.body(point - jnp.clip(point, -h, h))

    def claims(self):
        part, h = claims(self.body), self.half_extents
        boxes = {
            name: _with_origin(box).padded(h)
            for name, box in (("inside", part.inside), ("outside", part.outside))
        }
        return part.weakened(**boxes)


class Twisted(AbstractField):
    """The body turned about the z-axis by `rate` radians per unit of height.

    f(R(-rate z) x). A lower bound, over the Lipschitz constant: with u = |rate| times
    the radius of the body's box it is (u + sqrt(u^2 + 4)) / 2 times the body's, + 1.
    """

    body: Callable
    rate: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        radius = self._radius().astype(point.dtype)
        held, beyond = _held(point, radius)
        angle = -self.rate * point[2]
        c, s = jnp.cos(angle), jnp.sin(angle)
        x, y = held
        turned = jnp.stack([c * x - s * y, s * x + c * y, point[2]])
        return self.body(turned) + beyond

    def claims(self):
        part, radius = claims(self.body), self._radius()
        u = jnp.abs(self.rate) * radius
        stretch = (u + jnp.sqrt(u * u + 4)) / 2
        low, high = part.inside.low, part.inside.high
        round_box = Bounds.of(
            jnp.stack([-radius, -radius, low[2]]),
            jnp.stack([radius, radius, high[2]]),
            0.0,
        )
        return Claims(
            part.lipschitz * stretch + 1,
            part.weakened().exactness,
            round_box,
            Bounds.everywhere(),
        )

    def _radius(self):
        return _reach(claims(self.body).inside, 2)


class Bent(AbstractField):
    """The body's x-axis laid on a circle of radius 1 / rate in the xy-plane, which
    starts at the origin along x and turns towards y; rate > 0 (1 / length).

    f(q) with q = (angle / rate, 1 / rate - r, z), r and angle around (0, 1 / rate), and
    at most r. A lower bound, over the Lipschitz constant: 1 and twice that of f over
    1 - rate y, y the largest in the body's box (infinite where the body reaches the
    center). The body must be shorter than the circle, |x| < pi / rate.
    """

    body: Callable
    rate: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        bend = 1 / self.rate
        spoke = jnp.stack([point[0], bend - point[1]])
        r = safe_norm(spoke)
        lost = r > 0
        angle = jnp.where(lost, jnp.arctan2(spoke[0], jnp.where(lost, spoke[1], 1)), 0)
        box = claims(self.body).inside
        # Nearer to the center the angle changes too fast: stay where the body is.
        height = jnp.minimum(bend - r, box.high[1].astype(point.dtype))
        beyond = bend - r - height
        turn = 2 * jnp.pi
        at = lambda a: self.body(jnp.stack([a * bend, height, point[2]]))
        # Beyond the half turn the other end of the body may be nearer.
        near = jnp.minimum(at(angle), at(angle - turn * jnp.sign(angle))) + beyond
        # Around the center, where the angle changes without bound, this is the least.
        return jnp.minimum(near, r)

    def claims(self):
        part = claims(self.body)
        box, bend = part.inside, 1 / self.rate
        least = 1 - self.rate * box.high[1]
        stretch = jnp.where(least > 0, 1 / jnp.where(least > 0, least, 1), jnp.inf)
        outer = bend - box.low[1]
        low = jnp.stack([-outer, bend - outer, box.low[2]])
        high = jnp.stack([outer, bend + outer, box.high[2]])
        return Claims(
            2 * part.lipschitz * stretch + 1,
            part.weakened().exactness,
            Bounds.of(low, high, 0.0),
            Bounds.everywhere(),
        )


class Tapered(AbstractField):
    """The body's sections scaled by a factor that goes linearly from `bottom` at the
    lower end of its box to `top` at the upper end; both positive.

    m f(x / s(z), y / s(z), z) with m = min(bottom, top, 1). A lower bound, over the
    Lipschitz constant; the body's box must be finite along z.
    """

    body: Callable
    bottom: Float[Array, ""] = eqx.field(converter=scalar)
    top: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        box = claims(self.body).inside
        low, high = box.low.astype(point.dtype), box.high.astype(point.dtype)
        t = jnp.clip(safe_divide(point[2] - low[2], high[2] - low[2]), 0, 1)
        factor = self.bottom + (self.top - self.bottom) * t
        wide = _reach(box, 2) * jnp.maximum(self.bottom, self.top)
        held, beyond = _held(point, wide.astype(point.dtype))
        inner = self.body(jnp.append(held / factor, point[2])) + beyond
        return self._least() * inner

    def claims(self):
        part = claims(self.body)
        box, reach = part.inside, _reach(part.inside, 2)
        least = jnp.minimum(self.bottom, self.top)
        widest = jnp.maximum(self.bottom, self.top)
        # d(x / s) = dx / s - x s' dz / s^2, with |x| at most reach times the widest.
        slope = safe_divide(jnp.abs(self.top - self.bottom), box.high[2] - box.low[2])
        shear = reach * widest * slope / least**2
        across = jnp.maximum(1 / least, 1)
        inner = part.lipschitz * (across + shear) + 1
        wide = reach * widest
        low = jnp.stack([-wide, -wide, box.low[2]])
        high = jnp.stack([wide, wide, box.high[2]])
        return Claims(
            self._least() * inner,
            part.weakened().exactness,
            Bounds.of(low, high, 0.0),
            Bounds.everywhere(),
        )

    def _least(self):
        return jnp.minimum(jnp.minimum(self.bottom, self.top), 1)


class Displaced(AbstractField):
    """f(x) + g(x): the surface moved inwards where g is positive, outwards where not.

    A lower bound, over the Lipschitz constant, which is the sum of both. `amplitude` is
    a bound of |g|, by which the box grows.
    """

    body: Callable
    displacement: Callable
    amplitude: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return self.body(point) + self.displacement(point)

    def claims(self):
        part, other = claims(self.body), claims(self.displacement)
        inside = part.inside.grown(self.amplitude)
        outside = part.outside.grown(self.amplitude)
        steep = part.lipschitz + other.lipschitz
        return part.weakened(inside=inside, outside=outside, lipschitz=steep)


class Morphed(AbstractField):
    """(1 - t) a + t b: between two bodies, t in [0, 1] (beyond, it overdoes).

    A lower bound for t in [0, 1]. Its box is that of both together.
    """

    first: Callable
    second: Callable
    t: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return (1 - self.t) * self.first(point) + self.t * self.second(point)

    def claims(self):
        a, b = claims(self.first), claims(self.second)
        sizes = jnp.abs(1 - self.t), jnp.abs(self.t)
        hull = a.inside.hull(b.inside)
        far = a.outside.hull(b.outside)
        between = (self.t >= 0) & (self.t <= 1)
        boxes = (_if_else(between, box) for box in (hull, far))
        inside, outside = boxes
        return a.union(b).weakened(
            lipschitz=sizes[0] * a.lipschitz + sizes[1] * b.lipschitz,
            inside=inside,
            outside=outside,
        )


def _if_else(known, box: Bounds) -> Bounds:
    ends = jnp.where(known, 0, jnp.inf)
    return Bounds(box.low - ends, box.high + ends, jnp.where(known, box.growth, 0))


def _held(point, radius):
    """The point [2] of the disk of `radius` nearest to (x, y), and how far that is."""
    flat = point[:2]
    r = safe_norm(flat)
    far = r > radius
    shrink = jnp.where(far, radius / jnp.where(far, r, 1), 1)
    return flat * shrink, jnp.where(far, r - radius, 0)


def _reach(box: Bounds, axes: int):
    """The farthest point of a box from the origin in its first axes."""
    ends = jnp.maximum(jnp.abs(box.low), jnp.abs(box.high))[:axes]
    ended = jnp.isfinite(ends)
    reach = safe_norm(jnp.where(ended, ends, 0))
    return jnp.where(jnp.all(ended), reach, jnp.inf)


def _with_origin(box: Bounds) -> Bounds:
    """The box made to hold the origin."""
    low, high = jnp.minimum(box.low, 0), jnp.maximum(box.high, 0)
    return Bounds(low, high, box.growth)
