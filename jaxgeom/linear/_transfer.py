"""Between a grid and the grid of twice its spacing.

Nodes are cell centers: coarse node c lies between fine nodes 2c and 2c + 1, at fine
index 2c + 1/2. Prolongation is the trilinear interpolant (weights 3/4 and 1/4 along
each axis; also the refinement rule of the quadratic B-spline), restriction is exactly
its transpose. An axis of n nodes has ceil(n / 2) coarse ones. With a `token` the axes
are kept apart (see `stage`), which is twice as fast on large grids.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core import stage
from ._stencils import take

Shape = tuple[int, int, int]


def coarse_shape(shape: Shape) -> Shape:
    """The number of nodes of the next coarser grid."""
    return tuple(-(-n // 2) for n in shape)


def prolong(
    u: Float[Array, "x y z"],
    shape: Shape,
    *,
    onto: Float[Array, "i j k"] | None = None,
    token: Bool[Array, ""] | None = None,
) -> Float[Array, "i j k"]:
    """P u on the finer grid of `shape`, added to the values `onto`, if any."""
    u = stage(token, lambda u: interleaved(u, shape[2]), u)
    if onto is None:
        return stage(token, lambda u: finer(finer(u, 1, shape[1]), 0, shape[0]), u)
    added = lambda v, u: v + finer(finer(u, 1, shape[1]), 0, shape[0])
    return stage(token, added, onto, u)


def restrict(
    u: Float[Array, "x y z"], *, token: Bool[Array, ""] | None = None
) -> Float[Array, "i j k"]:
    """P^T u on the coarser grid: sums are kept."""
    for axis in range(3):
        u = stage(token, lambda u, axis=axis: coarser(u, axis), u)
    return u


@partial(jax.jit, static_argnames="n")
def interleaved(u, n):
    """P along the last axis, where gathers are slow: even and odd nodes apart."""
    last = u.shape[2] - 1
    index = np.arange(last + 1)
    even = 0.75 * u + 0.25 * take(u, np.maximum(index - 1, 0), 2)
    odd = 0.75 * u + 0.25 * take(u, np.minimum(index + 1, last), 2)
    return jnp.stack([even, odd], axis=-1).reshape(*u.shape[:2], -1)[..., :n]


@partial(jax.jit, static_argnames=("axis", "n"))
def finer(u, axis, n):
    """P along one axis."""
    fine = np.arange(n)
    near = fine // 2
    far = np.clip(near + np.where(fine % 2 == 0, -1, 1), 0, u.shape[axis] - 1)
    return 0.75 * take(u, near, axis) + 0.25 * take(u, far, axis)


@partial(jax.jit, static_argnames="axis")
def coarser(u, axis):
    """P^T along one axis."""
    n = u.shape[axis]
    coarse = np.arange(-(-n // 2))
    terms = []
    for offset, weight in ((-1, 0.25), (0, 0.75), (1, 0.75), (2, 0.25)):
        source, exists = _source(2 * coarse + offset, n)
        weights = jnp.asarray(weight * exists, u.dtype)
        column = weights.reshape([-1 if a == axis else 1 for a in range(3)])
        terms.append(column * take(u, source, axis))
    return sum(terms)


def _source(index, n):
    """The fine node behind each index; the ends count twice, as `prolong` clips.

    Beyond the last node of an odd axis there is nothing to fold back: that node reads
    the coarse node before it.
    """
    exists = (index < n) | ((index == n) & (n % 2 == 0))
    return np.clip(index, 0, n - 1), exists
