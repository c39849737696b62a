"""The answer of every reconstruction method: a field on a grid, with its level."""

import equinox as eqx
from jaxtyping import Array, Float, Int

from .._core import RESULTS
from ..linear import interpolate
from ..shapes import Grid


class PoissonStats(eqx.Module):
    """How the field was found.

    - `residual`: [], relative residual of the linear system; `steps`: [], iterations.
    - `screening`: [], the weight that was used; `noise`: [], the estimated standard
      deviation of the samples across the surface, in the unit of the points.
    - `area`: [n], the surface area that each sample stands for, in squared units.
    - `num_ignored`: [], samples without a usable normal or too near the sides.
    """

    residual: Float[Array, ""]
    steps: Int[Array, ""]
    screening: Float[Array, ""]
    noise: Float[Array, ""]
    area: Float[Array, " n"]
    num_ignored: Int[Array, ""]


class FieldSolution(eqx.Module):
    """A field sampled on a grid; its surface is where `values` equal `level`.

    Itself a field: `solution(point)` is the trilinear interpolant less the level,
    negative inside. `density` holds the samples per unit of area of surface around each
    node of the grid of twice the spacing (`grid.coarser()`); it falls to zero where
    the surface was not seen.
    """

    grid: Grid
    values: Float[Array, "x y z"]
    level: Float[Array, ""]
    density: Float[Array, "i j k"]
    result: RESULTS
    stats: PoissonStats

    def __call__(self, point: Float[Array, " 3"]) -> Float[Array, ""]:
        """The value at one point [3], clamped to the box."""
        q = self.grid.index_of(point)[None]
        return interpolate(self.values, q)[0] - self.level

    def density_at(self, points: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """The samples per unit of area around points [n, 3]."""
        return interpolate(self.density, self.grid.coarser().index_of(points))
