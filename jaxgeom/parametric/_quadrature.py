"""Gauss-Legendre quadrature on cells that respect the breaks of an interval."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._domain import Interval


def rule(
    interval: Interval, cells: int, order: int
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """The nodes and weights of composite quadrature over an interval."""
    x, w = np.polynomial.legendre.leggauss(order)
    borders = interval.nodes(cells)
    middle, half = (borders[1:] + borders[:-1]) / 2, np.diff(borders) / 2
    nodes = middle[:, None] + half[:, None] * x
    return jnp.asarray(nodes.ravel()), jnp.asarray((half[:, None] * w).ravel())
