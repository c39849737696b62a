"""The exact signed distance of a plane region whose border is lines and arcs.

The border is a closed chain of corners [n, 2], counter-clockwise. Edge i goes from
corner i to corner i + 1; its bulge is tan(sweep / 4) of an arc of a circle (positive:
outwards), and 0 for a straight edge, as in CAD drawings. The nearest feature decides:
a line or an arc gives a signed formula that is smooth across the border, a corner gives
the distance to it, with the sign of the even-odd rule.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import safe_divide, safe_norm
from ._claims import Bounds, Claims
from ._field import AbstractField


class Outline(eqx.Module):
    """Corners [n, 2], counter-clockwise, and the bulges [n] of the edges after them."""

    corners: Float[Array, "n 2"]
    bulges: Float[Array, " n"] | None = None

    @staticmethod
    def of(corners, bulges=None) -> "Outline":
        """From lists of pairs of numbers and of numbers, some of them arrays."""
        rows = [jnp.stack([jnp.asarray(x) for x in row]) for row in corners]
        if bulges is not None:
            bulges = jnp.stack([jnp.asarray(b, rows[0].dtype) for b in bulges])
        return Outline(jnp.stack(rows), bulges)


class AbstractOutlined(AbstractField):
    """A region of the plane with a border of lines and arcs. Exact distance."""

    @abstractmethod
    def outline(self) -> Outline:
        """The border, which must not cross itself."""

    def evaluate(self, point):
        return outline_distance(self.outline(), point)

    def claims(self):
        return Claims.distance(outline_bounds(self.outline()))


def outline_distance(outline: Outline, point: Float[Array, " 2"]) -> Float[Array, ""]:
    """The signed distance of the region inside an outline."""
    start, end = outline.corners, jnp.roll(outline.corners, -1, axis=0)
    along, gap = end - start, point - start
    side = _cross(along, gap)
    length = safe_norm(along)
    t = safe_divide(jnp.sum(gap * along, axis=1), length**2)
    # Counter-clockwise, the outside is on the right of an edge.
    flat = jnp.where((t > 0) & (t < 1), -safe_divide(side, length), jnp.inf)
    rising = along[:, 1] > 0
    left = jnp.where(rising, side > 0, side >= 0)
    straddles = (start[:, 1] > point[1]) != (end[:, 1] > point[1])
    crossed = straddles & (left == rising)
    if outline.bulges is not None:
        flat, crossed = _with_arcs(outline, point, flat, crossed, left)
    inside = jnp.sum(crossed) % 2 == 1
    away = jnp.where(inside, -1, 1) * safe_norm(gap)
    features = jnp.concatenate([flat, away])
    return features[jnp.argmin(jnp.abs(features))]


def outline_bounds(outline: Outline) -> Bounds:
    """The box around an outline."""
    corners = outline.corners
    low, high = jnp.min(corners, axis=0), jnp.max(corners, axis=0)
    if outline.bulges is None:
        return Bounds.of(low, high)
    start, along, bulge, center, radius = _circles(outline)
    for axis in range(2):
        for sign in (-1, 1):
            step = sign * radius[:, None] * jnp.eye(2, dtype=low.dtype)[axis]
            extreme = center + step
            on_arc = _beyond(along, extreme - start, bulge) & (bulge != 0)
            reached = jnp.where(on_arc[:, None], extreme, corners)
            low = jnp.minimum(low, jnp.min(reached, axis=0))
            high = jnp.maximum(high, jnp.max(reached, axis=0))
    return Bounds.of(low, high)


def _with_arcs(outline, point, flat, crossed, left):
    """The distances to curved edges in place of their chords, and the corrected sides:
    between an arc and its chord, in and out change places."""
    start, along, bulge, center, radius = _circles(outline)
    spoke = point - center
    distance = safe_norm(spoke)
    nearest = center + safe_divide(radius, distance)[:, None] * spoke
    curved = bulge != 0
    facing = _beyond(along, nearest - start, bulge)
    signed = jnp.sign(bulge) * (distance - radius)
    arc = jnp.where(facing, signed, jnp.inf)
    between = (distance < radius) & (left == (bulge < 0))
    return jnp.where(curved, arc, flat), crossed ^ (curved & between)


def _circles(outline):
    """Start, chord, bulge, center and radius of every edge (radius 1 for straight)."""
    start, bulge = outline.corners, outline.bulges
    along = jnp.roll(start, -1, axis=0) - start
    safe = jnp.where(bulge == 0, 1, bulge)
    normal = jnp.stack([-along[:, 1], along[:, 0]], axis=1)
    center = start + along / 2 + ((1 - safe**2) / (4 * safe))[:, None] * normal
    radius = safe_norm(along) * (1 + safe**2) / (4 * jnp.abs(safe))
    return start, along, bulge, center, radius


def _beyond(along, gap, bulge) -> Bool[Array, " n"]:
    """Whether points of the circles lie on their arcs: on the bulging side."""
    return _cross(along, gap) * bulge <= 0


def _cross(a, b):
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
