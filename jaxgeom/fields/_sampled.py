"""Fields known by their values at the nodes of a grid."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import check_shape
from ..linear import interpolate
from ..shapes import Grid
from ._claims import IMPLICIT_ONLY, Bounds, Claims
from ._field import AbstractField


class Sampled(AbstractField):
    """The trilinear interpolant of values [x, y, z] at the nodes of a grid.

    Implicit only: as near to a distance as its samples. A point outside takes the value
    of the nearest point of the grid's box, with zero gradient across the box.
    Differentiable with respect to values, grid and point.
    """

    grid: Grid
    values: Float[Array, "x y z"] = eqx.field()

    def __check_init__(self):
        check_shape("values", self.values, self.grid.shape)

    def claims(self):
        return sampled_claims(self.grid, self.values)

    def evaluate(self, point):
        return interpolate(self.values, self.grid.index_of(point)[None])[0]


def sampled_claims(grid: Grid, values: Float[Array, "x y z"], factor=1.0) -> Claims:
    """Those of an interpolant whose slope along an axis is at most `factor` times the
    steepest difference of neighbors.

    The box is that of the grid where all values on its border are positive: beyond it
    the border's values go on.
    """
    slopes = [
        jnp.max(jnp.abs(jnp.diff(values, axis=d))) / grid.spacing[d] for d in range(3)
    ]
    steepest = factor * jnp.linalg.norm(jnp.stack(slopes))
    last = jnp.asarray(grid.shape) - 1
    low, high = grid.origin, grid.origin + grid.spacing * last.astype(grid.origin.dtype)
    boxes = [_box_if(low, high, _border_above(sign * values)) for sign in (1, -1)]
    return Claims(steepest, IMPLICIT_ONLY, *boxes)


def _border_above(values):
    """Whether all values on the six faces are positive."""
    faces = [jnp.take(values, i, axis=d) for d in range(3) for i in (0, -1)]
    return jnp.stack([jnp.min(face) for face in faces]).min() > 0


def _box_if(low, high, closed):
    ends = jnp.where(closed, 0, jnp.inf)
    return Bounds.of(low - ends, high + ends, 0.0)
