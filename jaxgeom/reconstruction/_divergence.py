"""The right side of the Poisson equation: normals smeared as widely as samples lie."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core import stage
from ..linear import prolong, splat_gradient
from ._density import at_level


def levels_for(num_samples: int, shape: tuple[int, int, int]) -> int:
    """How many coarser grids the samples need, from their number and the resolution.

    A surface of four middle sections of the grid, shared by n samples of equal area,
    puts each sample on the level where it fills one cell.
    """
    cells = 4 * float(np.prod(shape)) ** (2 / 3)
    per_sample = max(cells / max(num_samples, 1), 1.0)
    deepest = math.floor(math.log2(min(shape))) - 3
    return max(min(math.ceil(math.log(per_sample, 4)), deepest), 0)


def divergence(
    q: Float[Array, "n 3"],
    vectors: Float[Array, "n 3"],
    area: Float[Array, " n"],
    shape: tuple[int, int, int],
    levels: int,
    *,
    token: Bool[Array, ""] | None = None,
) -> Float[Array, "x y z"]:
    """The right side; each sample is smeared on the grid where it fills one cell.

    Prolongation is the refinement rule of the quadratic B-spline, so that the kernel of
    a coarse grid, prolonged, is the wide kernel on the fine one. In units of the finer
    grid it is 1/4 as strong per level: 1/16 for area and gradient together with the
    factor 4 of the coarse grid's own unit of area.
    """
    side = None
    for level in reversed(range(levels + 1)):
        coarse, here = at_level(q, shape, level)
        share = _share(area, level, levels) / 4.0**level
        if side is not None:
            side = prolong(side / 4, here, token=token)
        spray = lambda v, q, u, here=here: splat_gradient(v, q, here, onto=u)
        side = stage(token, spray, vectors * share[:, None], coarse, side)
    return side


def _share(area, level, last):
    """How much of a sample of this area (in cells) a level gets: a hat in log4."""
    fitting = jnp.log(jnp.maximum(area, 1.0)) / jnp.log(4.0)
    fitting = jnp.minimum(fitting, last)
    return jnp.maximum(1 - jnp.abs(fitting - level), 0.0)
