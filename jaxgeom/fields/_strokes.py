"""Bodies within a radius of points, lines and flat pieces, in the plane or in space."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import GeometryError, message, safe_divide, safe_norm
from ._claims import Bounds, Claims, Trust
from ._field import AbstractField
from ._parameters import array, scalar, vector
from ._solids import face_distance


class Polyline(AbstractField):
    """The points within `radius` of a chain of segments through `points` [n, d].

    Exact outside; a lower bound inside, where two segments' tubes overlap.
    """

    points: Float[Array, "n d"] = eqx.field(converter=array("points", None, None))
    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        start, along = self.points[:-1], jnp.diff(self.points, axis=0)
        return jnp.min(segment_distance(start, along, point)) - self.radius

    def claims(self):
        return _within(self.points, self.radius).trusted(Trust.EXACT, Trust.BOUND)


class Bezier(AbstractField):
    """The points within `radius` of the quadratic curve (1-t)^2 a + 2t(1-t) b + t^2 c,
    `controls` [3, d] = (a, b, c), d = 2 or 3.

    Exact outside; a lower bound inside, where the curve turns tighter than the radius.
    """

    controls: Float[Array, "3 d"] = eqx.field(converter=array("controls", 3, None))
    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        # The parameter is the best one: the distance does not change with it.
        t = jax.lax.stop_gradient(_nearest_parameter(self.controls, point))
        a, b, c = self.controls
        curve = (1 - t) ** 2 * a + 2 * t * (1 - t) * b + t * t * c
        return safe_norm(point - curve) - self.radius

    def claims(self):
        return _within(self.controls, self.radius).trusted(Trust.EXACT, Trust.BOUND)


class ThickPolygon(AbstractField):
    """The points within `radius` of a flat convex polygon with corners [n, 3].

    A triangle, a quadrangle, ...: exact distance.
    """

    corners: Float[Array, "n 3"] = eqx.field(converter=array("corners", None, 3))
    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return face_distance(self.corners, point)[1] - self.radius

    def claims(self):
        return _within(self.corners, self.radius)


class RoundTube(AbstractField):
    """The convex hull of two balls: a branch that tapers from start to end.

    Exact distance (the section is that of `RoundCone`), in closed form:
    with the height h along the axis and r beside it, the flank is met where the foot
    of the normal lies between the balls. Needs |start_radius - end_radius| < length.

    Source: I. Quilez, round cone.
    """

    start: Float[Array, " 3"] = eqx.field(converter=vector("start"))
    end: Float[Array, " 3"] = eqx.field(converter=vector("end"))
    start_radius: Float[Array, ""] = eqx.field(converter=scalar)
    end_radius: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        along, gap = self.end - self.start, point - self.start
        length = safe_norm(along)
        height = safe_divide(jnp.dot(gap, along), length)
        beside = safe_norm(gap - safe_divide(height, length) * along)
        sine = safe_divide(self.start_radius - self.end_radius, length)
        cosine = jnp.sqrt(jnp.maximum(1 - sine**2, jnp.finfo(sine.dtype).tiny))
        # The foot of the point on the axis, seen along the normal of the flank.
        foot = height - beside * sine / cosine
        flank = beside * cosine + height * sine - self.start_radius
        below = safe_norm(gap) - self.start_radius
        above = safe_norm(point - self.end) - self.end_radius
        return jnp.where(foot < 0, below, jnp.where(foot > length, above, flank))

    def claims(self):
        a, b = self.start, self.end
        low = jnp.minimum(a - self.start_radius, b - self.end_radius)
        high = jnp.maximum(a + self.start_radius, b + self.end_radius)
        return Claims.distance(Bounds.of(low, high))


def segment_distance(start, along, point) -> Float[Array, " n"]:
    """The distances of a point from segments [n, d] given by start and direction."""
    gap = point - start
    square = jnp.sum(along * along, axis=-1)
    t = jnp.clip(safe_divide(jnp.sum(gap * along, axis=-1), square), 0, 1)
    return safe_norm(gap - t[..., None] * along)


def stack_fields(fields: list[Callable]) -> Callable:
    """Fields of one kind as one field whose leaves have a leading axis (host).

    What `UnionOfMany` evaluates by `vmap`. All must have the same structure.
    """
    kinds = {jax.tree.structure(field) for field in fields}
    if len(kinds) != 1:
        raise GeometryError(
            message(
                "stacked fields must be of one kind",
                f"{len(kinds)} kinds among {len(fields)} fields",
                "Pass a tuple of fields to UnionOfMany instead.",
            )
        )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *fields)


def _nearest_parameter(controls, point):
    """The t in [0, 1] where a quadratic curve is nearest: a cubic's root or an end."""
    a, b, c = controls - point
    first, second = 2 * (b - a), a - 2 * b + c
    # |q|^2 for q = a + first t + second t^2 has the derivative 2 q . q'.
    cubic = jnp.stack(
        [
            2 * jnp.dot(second, second),
            3 * jnp.dot(first, second),
            jnp.dot(first, first) + 2 * jnp.dot(a, second),
            jnp.dot(a, first),
        ]
    )
    starts = jnp.linspace(0, 1, 9, dtype=point.dtype)
    found = jnp.clip(_polished(cubic, starts), 0, 1)
    q = a + first * found[:, None] + second * found[:, None] ** 2
    return found[jnp.argmin(jnp.sum(q * q, axis=1))]


def _polished(cubic, t):
    """Roots of a cubic near starts t, each between its neighbors (safe Newton)."""
    width = t[1] - t[0]
    low, high = t - width / 2, t + width / 2
    for _ in range(12):
        value = jnp.polyval(cubic, t)
        slope = jnp.polyval(jnp.polyder(cubic), t)
        low, high = jnp.where(value < 0, t, low), jnp.where(value > 0, t, high)
        step = t - safe_divide(value, slope)
        fits = (step >= low) & (step <= high) & (slope > 0)
        t = jnp.where(fits, step, (low + high) / 2)
    return t


def _within(points, radius) -> Claims:
    low, high = jnp.min(points, axis=0) - radius, jnp.max(points, axis=0) + radius
    return Claims.distance(Bounds.of(low, high))
