"""A profile carried along a path in frames that do not turn about it.

Source: W. Wang, B. Juettler, D. Zheng, Y. Liu, Computation of rotation minimizing
frames, 2008 (the double reflection).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import GeometryError, message, safe_divide, safe_normalize
from ._abstract import AbstractCurve, AbstractSurface, scalar
from ._curve_queries import tangent
from ._domain import Domain


class Swept(AbstractSurface):
    """The plane curve `profile` carried along `path`: u on the profile, v on the path.

    X(u, v) = path(v) + x e1 + y e2, where (x, y, ...) = profile(u) and e1, e2 is a
    frame normal to the path that minimises rotation. On a periodic path the angle by
    which the frame misses itself after one turn is taken back evenly along it. With a
    counter-clockwise profile the normal points out of the tube.

    - `twist`: a turn about the path, in radians, added evenly along it; on a periodic
      path take one that maps the profile to itself.
    - `stations`: the static number of reflections along the path; the frame is right to
      the fourth order in 1 / stations, and continuous. Its derivative jumps at the
      stations by its error.

    Raises `GeometryError` for fewer than two stations.
    """

    path: AbstractCurve
    profile: AbstractCurve
    twist: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)
    stations: int = eqx.field(static=True, kw_only=True, default=64)

    def __check_init__(self):
        if self.stations < 2:
            must = "a swept surface needs at least 2 stations"
            raise GeometryError(message(must, f"{self.stations}", "Pass more."))

    def evaluate(self, uv):
        u, v = uv
        x, y = self.profile(u)[:2]
        e1, e2 = frame(self.path, v, twist=self.twist, stations=self.stations)
        return self.path(v) + x * e1 + y * e2

    def domain(self):
        return Domain(self.profile.interval(), self.path.interval())


def frame(
    path: AbstractCurve, t: Float[Array, ""], *, twist=0.0, stations: int = 64
) -> Float[Array, "2 3"]:
    """Two unit vectors normal to a path and to each other that do not turn about it.

    The first is carried along the path by double reflections between `stations` equal
    steps, and from the station before t to t. e2 = tangent x e1. On a periodic path
    the frame closes. `twist` [radians] is added evenly from the begin to the end.
    """
    span = path.interval()
    stops = jnp.asarray(span.nodes(stations), t.dtype)
    places = jax.vmap(path)(stops)
    ways = jax.vmap(lambda s: tangent(path, s))(stops)
    turned, firsts = _carry(places, ways)
    index = jnp.clip(jnp.searchsorted(stops, t, side="right") - 1, 0, len(stops) - 2)
    here, way = path(t), tangent(path, t)
    e1 = _reflected(places[index], ways[index], firsts[index], here, way)
    share = (t - span.low) / span.length
    closing = turned if span.periodic else 0.0
    e2 = jnp.cross(way, e1)
    angle = share * (twist - closing)
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * e1 + s * e2, c * e2 - s * e1])


def _carry(places, ways):
    """The angle the carried frame has turned at the end, and e1 at all stations."""

    def onward(e1, step):
        following = _reflected(step[0], step[1], e1, step[2], step[3])
        return following, following

    start = _any_normal(ways[0])
    steps = (places[:-1], ways[:-1], places[1:], ways[1:])
    last, rest = jax.lax.scan(onward, start, steps)
    sine = jnp.dot(jnp.cross(start, last), ways[0])
    angle = jnp.arctan2(sine, jnp.dot(start, last))
    return angle, jnp.concatenate([start[None], rest])


def _reflected(x0, t0, e1, x1, t1):
    """e1 carried from (x0, t0) to (x1, t1) by two reflections."""
    chord = x1 - x0
    # Of a chord in the rounding of the points the direction is lost; the sum of the
    # tangents has the same one, up to the square of the step.
    reach = jnp.maximum(jnp.max(jnp.abs(x0)), jnp.max(jnp.abs(x1)))
    short = jnp.dot(chord, chord) <= jnp.finfo(chord.dtype).eps * reach**2
    across = jnp.where(short, t0 + t1, chord)
    once = lambda x: _mirror(across, x)
    return safe_normalize(_mirror(t1 - once(t0), once(e1)))


def _mirror(across, x):
    """x reflected in the plane normal to `across`."""
    return x - safe_divide(2 * jnp.dot(across, x), jnp.dot(across, across)) * across


def _any_normal(t):
    """A unit vector normal to t: the axis least along it, made perpendicular."""
    axis = jax.lax.stop_gradient(jnp.argmin(jnp.abs(t)))
    unit = jnp.eye(3, dtype=t.dtype)[axis]
    return safe_normalize(unit - jnp.dot(unit, t) * t)
