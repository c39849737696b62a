"""The 7-point Laplacian with zero flux through the sides of the box (Neumann).

L = sum_d c_d D_d^T D_d, D_d the difference of neighboring nodes along axis d: positive
semidefinite, with the constants as its kernel. Clipped index vectors are the fastest
form under XLA on the CPU (a convolution is a thousand times slower).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def laplacian(
    u: Float[Array, "x y z"], coefficients: Float[Array, " 3"]
) -> Float[Array, "x y z"]:
    """L u; the coefficients c_d weigh the three axes."""
    out = jnp.zeros_like(u)
    for axis, n in enumerate(u.shape):
        index = jnp.arange(n)
        after = jnp.take(u, jnp.minimum(index + 1, n - 1), axis=axis)
        before = jnp.take(u, jnp.maximum(index - 1, 0), axis=axis)
        out = out + coefficients[axis] * (2 * u - after - before)
    return out


def laplacian_diagonal(
    shape: tuple[int, int, int], coefficients: Float[Array, " 3"]
) -> Float[Array, "x y z"]:
    """The diagonal of L: the number of neighbors along each axis, weighted."""
    out = jnp.zeros((), coefficients.dtype)
    for axis, n in enumerate(shape):
        index = jnp.arange(n)
        count = (index > 0).astype(coefficients.dtype) + (index < n - 1)
        out = out + coefficients[axis] * count.reshape(
            [-1 if a == axis else 1 for a in range(3)]
        )
    return out
