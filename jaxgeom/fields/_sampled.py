"""Fields known by their values at the nodes of a grid."""

import equinox as eqx
from jaxtyping import Array, Float

from .._core import check_shape
from ..linear import interpolate
from ..shapes import Grid
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

    def evaluate(self, point):
        return interpolate(self.values, self.grid.index_of(point)[None])[0]
