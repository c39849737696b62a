"""Stencils on grids with zero flux through the sides of the box (Neumann).

L = sum_d c_d D_d^T D_d, D_d the difference of neighboring nodes along axis d: positive
semidefinite, with the constants as its kernel. Clipped index vectors are the fastest
form under XLA on the CPU (a convolution is a thousand times slower), provided that no
bounds are checked.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import stage


def take(u: Float[Array, "x y z"], index: Int[Array, " n"], axis: int):
    """The slices of u at indices that are known to exist."""
    where = (slice(None),) * axis + (index,)
    return u.at[where].get(mode="promise_in_bounds")


@partial(jax.jit, static_argnames="axis")
def neighbors_along(u: Float[Array, "x y z"], axis: int):
    """The sum of both neighbors along an axis; the ends are their own neighbors."""
    n = u.shape[axis]
    index = jnp.arange(n)
    after = take(u, jnp.minimum(index + 1, n - 1), axis)
    return after + take(u, jnp.maximum(index - 1, 0), axis)


@jax.jit
def laplacian(
    u: Float[Array, "x y z"], coefficients: Float[Array, " 3"]
) -> Float[Array, "x y z"]:
    """L u; the coefficients c_d weigh the three axes."""
    return sum(c * (2 * u - neighbors_along(u, d)) for d, c in enumerate(coefficients))


def smooth(
    u: Float[Array, "x y z"], *, token: Bool[Array, ""] | None = None
) -> Float[Array, "x y z"]:
    """(1, 2, 1) / 4 along each axis; sums are kept. With a `token` (see `stage`) the
    axes are kept apart, which is faster on large grids."""
    for axis in range(3):
        u = stage(token, partial(_smooth_along, axis=axis), u)
    return u


def _smooth_along(u, axis):
    return 0.5 * u + 0.25 * neighbors_along(u, axis)


def laplacian_diagonal(
    shape: tuple[int, int, int], coefficients: Float[Array, " 3"]
) -> Float[Array, "x y z"]:
    """The diagonal of L: the number of neighbors along each axis, weighted."""
    out = jnp.zeros((), coefficients.dtype)
    for axis, n in enumerate(shape):
        index = jnp.arange(n)
        count = (index > 0).astype(coefficients.dtype) + (index < n - 1)
        line = [-1 if a == axis else 1 for a in range(3)]
        out = out + coefficients[axis] * count.reshape(line)
    return out
