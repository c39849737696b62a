"""Copies of a body: mirrored, in rows and grids, around an axis."""

import itertools
import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import safe_norm, safe_normalize
from ._claims import Bounds, Trust
from ._field import AbstractField, claims
from ._parameters import scalar, vector


class Mirrored(AbstractField):
    """The body and its image in the plane n . x = offset, n = normal / |normal|.

    min(f(x), f(x')). As exact outside as the body, a lower bound inside.
    """

    body: Callable
    normal: Float[Array, " 3"] = eqx.field(converter=vector("normal"))
    offset: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)

    def evaluate(self, point):
        n = safe_normalize(self.normal)
        image = point - 2 * (jnp.dot(n, point) - self.offset) * n
        return jnp.minimum(self.body(point), self.body(image))

    def claims(self):
        part, n = claims(self.body), safe_normalize(self.normal)
        image = _Reflection(jnp.eye(3, dtype=n.dtype) - 2 * jnp.outer(n, n), n, self)
        moved = part.replaced(
            inside=part.inside.image(image), outside=part.outside.image(image)
        )
        return part.union(moved)


class Repeated(AbstractField):
    """Copies of the body at all multiples of `spacing` [3], `counts` of them (static)
    along each axis, centered about the origin; None: without end.

    The value is the least over the nearest copy and `reach` (static) more on each side
    along the axes with several. As exact outside as the body, and with its Lipschitz
    constant, if no copy left out is nearer than those looked at: so for a body that
    holds the origin and fits into its cell, in cells no more than 1.4 times as long as
    wide. Raise `reach` for others.
    """

    body: Callable
    spacing: Float[Array, " 3"] = eqx.field(converter=vector("spacing"))
    counts: tuple[int | None, int | None, int | None] = eqx.field(
        static=True, default=(None, None, None)
    )
    reach: int = eqx.field(static=True, default=1)

    def evaluate(self, point):
        several = np.array([n != 1 for n in self.counts])
        last = jnp.array([jnp.inf if n is None else (n - 1) / 2 for n in self.counts])
        last = last.astype(point.dtype)
        # An even number of copies sits at odd halves of the spacing.
        half = np.array(
            [0.5 if n is not None and n % 2 == 0 else 0 for n in self.counts]
        )
        step = jnp.where(several, self.spacing, 1)
        cell = jax.lax.stop_gradient(jnp.round(point / step - half) + half)
        ranges = [range(-self.reach, self.reach + 1) if s else (0,) for s in several]
        offsets = jnp.asarray(list(itertools.product(*ranges)), point.dtype)
        cells = jnp.clip(jnp.clip(cell, -last, last) + offsets, -last, last)
        cells = jnp.where(several, cells, 0)
        at = lambda c: self.body(point - c * step)
        return jnp.min(jax.vmap(at)(cells))

    def claims(self):
        part = claims(self.body).trusted(Trust.EXACT, Trust.BOUND)
        ends = jnp.array([jnp.inf if n is None else (n - 1) / 2 for n in self.counts])
        single = np.array([n == 1 for n in self.counts])
        shift = jnp.where(single, 0, ends * jnp.where(single, 1, self.spacing))
        return part.replaced(
            inside=part.inside.padded(shift), outside=Bounds.everywhere()
        )


class PolarRepeated(AbstractField):
    """`count` (static) copies of the body, turned about the z-axis by equal angles.

    The least of the copies in the two sectors nearest to the point. As exact outside as
    the body, for a body within its sector, |angle| <= pi / count; a lower bound inside.
    """

    body: Callable
    count: int = eqx.field(static=True)

    def evaluate(self, point):
        sector = 2 * math.pi / self.count
        flat = safe_norm(point[:2]) > 0
        angle = jnp.arctan2(jnp.where(flat, point[1], 0), jnp.where(flat, point[0], 1))
        own = jax.lax.stop_gradient(jnp.round(angle / sector))
        turns = sector * (own + jnp.array([-1.0, 0.0, 1.0], point.dtype))
        return jnp.min(jax.vmap(lambda a: self.body(_turned(point, -a)))(turns))

    def claims(self):
        part = claims(self.body).trusted(Trust.EXACT, Trust.BOUND)
        ends = jnp.maximum(jnp.abs(part.inside.low), jnp.abs(part.inside.high))
        wide = jnp.sqrt(jnp.sum(ends[:2] ** 2))
        low = jnp.stack([-wide, -wide, part.inside.low[2]])
        high = jnp.stack([wide, wide, part.inside.high[2]])
        growth = part.inside.growth
        return part.replaced(
            inside=Bounds(low, high, growth), outside=Bounds.everywhere()
        )


class _Reflection(eqx.Module):
    """The reflection in a plane, as far as `Bounds.image` needs to know it."""

    matrix: Float[Array, "3 3"]
    unit: Float[Array, " 3"]
    plane: Mirrored

    def linear(self):
        return self.matrix

    def shift(self):
        return 2 * self.plane.offset * self.unit


def _turned(point, angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, y, z = point
    return jnp.stack([c * x - s * y, s * x + c * y, z])
