"""Fields known by their values at the nodes of a grid."""

import equinox as eqx
import jax
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


def sampled_claims(
    grid: Grid, values: Float[Array, "x y z"], factor=1.0, undershoot=0.0
) -> Claims:
    """Those of an interpolant whose slope along an axis is at most `factor` times the
    steepest difference of neighbors.

    The box is that of the grid where all values on its border are positive (the least
    of them above `undershoot` times the largest): beyond it the border's values go on.
    """
    slopes = [
        jnp.max(jnp.abs(jnp.diff(values, axis=d))) / grid.spacing[d] for d in range(3)
    ]
    steepest = factor * jnp.linalg.norm(jnp.stack(slopes))
    last = jnp.asarray(grid.shape) - 1
    low, high = grid.origin, grid.origin + grid.spacing * last.astype(grid.origin.dtype)
    boxes = [
        _box_if(low, high, _border_above(sign * values, undershoot)) for sign in (1, -1)
    ]
    return Claims(steepest, IMPLICIT_ONLY, *boxes)


def _border_above(values, undershoot):
    """Whether the interpolant is positive on the six faces."""
    faces = [jnp.take(values, i, axis=d) for d in range(3) for i in (0, -1)]
    least = jnp.stack([jnp.min(face) for face in faces]).min()
    return least > undershoot * jnp.stack([jnp.max(face) for face in faces]).max()


def _box_if(low, high, closed):
    ends = jnp.where(closed, 0, jnp.inf)
    return Bounds.of(low - ends, high + ends, 0.0)


class CubicSampled(AbstractField):
    """The tricubic interpolant of values [x, y, z] at the nodes of a grid.

    Cubic convolution along each axis (Catmull-Rom), once continuously differentiable,
    third order in the spacing for smooth fields. Implicit only: as near to a distance
    as its samples. A point outside takes the value of the nearest point of the grid's
    box. Beyond the border, the outermost values are repeated.

    Source: R. Keys, Cubic convolution interpolation, 1981 (a = -1/2).
    """

    grid: Grid
    values: Float[Array, "x y z"] = eqx.field()

    def __check_init__(self):
        check_shape("values", self.values, self.grid.shape)

    def claims(self):
        # Weights of one axis sum to at most 5/4 in size, those of differences to 3/2.
        # So the interpolant on a face is at least 1.5625 least - 0.5625 largest values.
        return sampled_claims(self.grid, self.values, 1.5 * 1.25**2, 0.36)

    def evaluate(self, point):
        index = self.grid.index_of(point)
        sides, weights = zip(
            *(_keys(index[d], n) for d, n in enumerate(self.grid.shape)), strict=True
        )
        block = self.values[jnp.ix_(*sides)]
        return jnp.einsum("i,j,k,ijk->", *weights, block)


def _keys(index, count):
    """The four nodes around a place on an axis, and their weights."""
    index = jnp.clip(index, 0, count - 1)
    cell = jnp.clip(jnp.floor(jax.lax.stop_gradient(index)), 0, count - 2)
    t = index - cell
    nodes = jnp.clip(cell.astype(jnp.int32) + jnp.arange(-1, 3), 0, count - 1)
    weights = jnp.stack(
        [
            -t * (1 - t) ** 2 / 2,
            1 - 2.5 * t**2 + 1.5 * t**3,
            t * (1 + 4 * t - 3 * t**2) / 2,
            -(t**2) * (1 - t) / 2,
        ]
    )
    return nodes, weights
