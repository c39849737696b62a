"""Between a grid and the grid of twice its spacing.

Nodes are cell centers: coarse node c lies between fine nodes 2c and 2c + 1, at fine
index 2c + 1/2. Prolongation is the trilinear interpolant (weights 3/4 and 1/4 along
each axis; also the refinement rule of the quadratic B-spline), restriction is exactly
its transpose. An axis of n nodes has ceil(n / 2) coarse ones.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._stencils import take

Shape = tuple[int, int, int]


def coarse_shape(shape: Shape) -> Shape:
    """The number of nodes of the next coarser grid."""
    return tuple(-(-n // 2) for n in shape)


def prolong(u: Float[Array, "x y z"], shape: Shape) -> Float[Array, "i j k"]:
    """P u on the finer grid of `shape`."""
    for axis, n in enumerate(shape):
        fine = np.arange(n)
        near = fine // 2
        far = np.clip(near + np.where(fine % 2 == 0, -1, 1), 0, -(-n // 2) - 1)
        u = 0.75 * take(u, near, axis) + 0.25 * take(u, far, axis)
    return u


def restrict(u: Float[Array, "x y z"]) -> Float[Array, "i j k"]:
    """P^T u on the coarser grid: sums are kept."""
    for axis, n in enumerate(u.shape):
        coarse = np.arange(-(-n // 2))
        terms = []
        for offset, weight in ((-1, 0.25), (0, 0.75), (1, 0.75), (2, 0.25)):
            source, exists = _source(2 * coarse + offset, n)
            weights = jnp.asarray(weight * exists, u.dtype)
            column = weights.reshape([-1 if a == axis else 1 for a in range(3)])
            terms.append(column * take(u, source, axis))
        u = sum(terms)
    return u


def _source(index, n):
    """The fine node behind each index; the ends count twice, as `prolong` clips.

    Beyond the last node of an odd axis there is nothing to fold back: that node reads
    the coarse node before it.
    """
    exists = (index < n) | ((index == n) & (n % 2 == 0))
    return np.clip(index, 0, n - 1), exists
