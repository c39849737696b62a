"""Which inside corners are connected across a face where the signs do not tell.

On an ambiguous face the two inside corners are the ends of a diagonal. Both cells that
share the face must decide alike: the decision is made once, for the face.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt

from .._core import stage
from ._bits import pack


class Decisions(eqx.Module):
    """What a rule says where the signs do not.

    - `joined`: by normal axis and lowest node, the faces whose inside corners would be
      connected if they were ambiguous.
    - `tunnels`: by lowest node, the cells where the inside (first) or the outside
      (second) would run through between two pieces of surface, if there were two.

    None stands for none at all.
    """

    joined: UInt[Array, "3 x y w"] | None = None
    tunnels: UInt[Array, "2 x y w"] | None = None


class AbstractFaceRule(eqx.Module):
    """A rule for what the signs of the corners leave open."""

    @abstractmethod
    def __call__(
        self,
        values: Float[Array, "x y z"],
        level: Float[Array, ""],
        token: Bool[Array, ""] | None,
    ) -> Decisions:
        """The decisions on a grid of values, as bits."""


class SeparateInside(AbstractFaceRule):
    """Inside corners across a diagonal stay apart, whatever the values: fastest."""

    def __call__(self, values, level, token):
        return Decisions()


class AsymptoticDecider(AbstractFaceRule):
    """As the bilinear interpolant of the face: Nielson and Hamann (1991).

    The saddle of the values a, b, c, d around the face is (a c - b d) / (a + c - b - d)
    above the level; it lies inside where the product of the inside pair is larger.
    """

    def __call__(self, values, level, token):
        return Decisions(_joined(values, level, token))


class TrilinearDecider(AbstractFaceRule):
    """As the trilinear interpolant of the cell, tunnels between two pieces of surface
    included: the mesh has its topology.

    On a slice at t along an axis the saddle of the bilinear interpolant is at the level
    where q(t) = (1 - t)^2 g0 + t (1 - t) c + t^2 g1 vanishes, g0 and g1 the gains
    a c - b d of the two end faces and c their mixed term. The three axes share the
    discriminant c^2 - 4 g0 g1, Cayley's hyperdeterminant of the 8 values. A tunnel
    is there if and only if all six roots lie within the cell, which is

        c^2 > 4 g0 g1,   g0 g1 > 0 and c g0 < 0 along every axis.

    The value in the middle of the roots tells which side runs through it.

    Nielson (2003), "On marching cubes"; Grosso (2016), "Construction of topologically
    correct and manifold isosurfaces": the roots are the inner hexagon of that paper.
    """

    def __call__(self, values, level, token):
        tunnels = stage(token, _tunnels, values, level)
        return Decisions(_joined(values, level, token), tunnels)


def _joined(values, level, token):
    decide = lambda v, axis: pack(_inside_saddle(v, level, axis))
    words = [stage(token, lambda v, a=axis: decide(v, a), values) for axis in range(3)]
    return jnp.stack(words)


def _inside_saddle(values, level, axis):
    """True where the saddle of the face normal to `axis` is inside."""
    u, v = ((axis + 1) % 3, (axis + 2) % 3)
    here = values - level
    along_u, along_v = _following(here, u), _following(here, v)
    gain = _gain(here, along_u, _following(along_u, v), along_v)
    return jnp.where(here < 0, gain > 0, gain < 0)


def _gain(a, b, c, d):
    return a * c - b * d


def _tunnels(values, level):
    ends = [_end_faces(values - level, axis) for axis in range(3)]
    crossed, middle = zip(*(_roots(low, high) for low, high in ends), strict=True)
    exist = crossed[0] & crossed[1] & crossed[2]
    inside = exist & (_trilinear(*ends[0], middle) < 0)
    words = [pack(jnp.pad(c, [(0, 1)] * 3)) for c in (inside, exist & ~inside)]
    return jnp.stack(words)


def _end_faces(values, axis):
    """The values a, b, c, d around the two faces of all cells that are normal to an
    axis. Slices, which are read faster than the gathers of `_following`."""
    u, v = ((axis + 1) % 3, (axis + 2) % 3)

    def corner(*steps):
        first = [0, 0, 0]
        for direction, step in zip((axis, u, v), steps, strict=True):
            first[direction] = step
        cells = zip(first, values.shape, strict=True)
        return values[tuple(slice(at, at + n - 1) for at, n in cells)]

    ring = [(0, 0), (1, 0), (1, 1), (0, 1)]
    return [[corner(end, *at) for at in ring] for end in (0, 1)]


def _roots(low, high):
    """Whether both roots lie between two opposite faces, and where their middle is."""
    first, last = _gain(*low), _gain(*high)
    (a, b, c, d), (e, f, g, h) = low, high
    mixed = a * g + e * c - b * h - f * d
    within = (first * last > 0) & (mixed * first < 0)
    # Where both roots are within, all three terms have one sign.
    total = jnp.where(within, first + last - mixed, 1.0)
    return within & (mixed**2 > 4 * first * last), (first - mixed / 2) / total


def _trilinear(low, high, place):
    """The interpolant between two faces normal to x at a place of each cell."""
    x, y, z = place
    mix = lambda p, q, t: p + t * (q - p)
    a, b, c, d = (mix(p, q, x) for p, q in zip(low, high, strict=True))
    return mix(mix(a, b, y), mix(d, c, y), z)


def _following(values, axis):
    """The value at the next node along an axis; the last repeats itself."""
    n = values.shape[axis]
    index = np.minimum(np.arange(n) + 1, n - 1)
    where = (slice(None),) * axis + (index,)
    return values.at[where].get(mode="promise_in_bounds")


def ambiguous(inside_next) -> UInt[Array, "x y w"]:
    """Faces with exactly the two ends of a diagonal inside, from the words of the four
    corners in order around the face."""
    a, b, c, d = inside_next
    return (a ^ b) & (b ^ c) & (c ^ d)
