"""Formulas whose textbook form has a NaN gradient or is slow under XLA."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


def safe_norm(x: Float[Array, "..."], axis: int = -1, keepdims: bool = False):
    """The Euclidean norm along `axis`, with gradient zero (not NaN) at the origin."""
    square = jnp.sum(x * x, axis=axis, keepdims=keepdims)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def safe_normalize(x: Float[Array, "..."], axis: int = -1) -> Float[Array, "..."]:
    """x / |x| along `axis`; the zero vector stays zero, with zero gradient."""
    # Scaling by the largest entry first keeps tiny vectors from underflowing.
    peak = jax.lax.stop_gradient(jnp.max(jnp.abs(x), axis=axis, keepdims=True))
    scaled = x / jnp.where(peak > 0, peak, 1.0)
    norm = safe_norm(scaled, axis=axis, keepdims=True)
    return scaled / jnp.where(norm > 0, norm, 1.0)


def safe_divide(a, b):
    """a / b, and 0 with zero gradient where b = 0."""
    nonzero = b != 0
    return jnp.where(nonzero, a, 0.0) / jnp.where(nonzero, b, 1.0)


def masked_mean(values, mask):
    """The mean of `values` where `mask`; 0 where there are none."""
    total = jnp.sum(jnp.where(mask, values, 0))
    return safe_divide(total, jnp.sum(mask).astype(total.dtype))


def tangents_to(n: Float[Array, " 3"]) -> Float[Array, "2 3"]:
    """Two unit vectors at right angles to the unit vector n and to each other.

    Source: T. Duff et al., Building an orthonormal basis, revisited, 2017.
    """
    x, y, z = n
    sign = jnp.where(z < 0, -1, 1).astype(n.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x])
    second = jnp.stack([b, sign + y * y * a, -y])
    return jnp.stack([first, second])


def eigen_two(
    matrix: Float[Array, "2 2"],
) -> tuple[Float[Array, " 2"], Float[Array, "2 2"]]:
    """The eigenvalues of a symmetric matrix, largest first, and its unit eigenvectors
    in the rows: with gradient zero, and those of the axes, where both values agree."""
    mean = (matrix[0, 0] + matrix[1, 1]) / 2
    half = jnp.stack([(matrix[0, 0] - matrix[1, 1]) / 2, matrix[0, 1]])
    radius = safe_norm(half)
    same = radius == 0
    turn = jnp.arctan2(jnp.where(same, 0, half[1]), jnp.where(same, 1, half[0])) / 2
    c, s = jnp.cos(turn), jnp.sin(turn)
    return jnp.stack([mean + radius, mean - radius]), jnp.array([[c, s], [-s, c]])


_BLOCK = 16
_SMALL = 4096


def prefix_sum(x: Int[Array, " n"]) -> Int[Array, " n"]:
    """The exclusive prefix sum of a vector of integers: out[i] = x[0] + ... + x[i-1].

    Blocks of 16 are summed by a triangular matrix, their totals by recursion:
    several times faster on a CPU than `jnp.cumsum` beyond a few thousand entries.
    """
    if x.shape[0] <= _SMALL:
        return jnp.cumsum(x) - x
    blocks = -(-x.shape[0] // _BLOCK)
    rows = jnp.pad(x, (0, blocks * _BLOCK - x.shape[0])).reshape(blocks, _BLOCK)
    before = jnp.asarray(np.triu(np.ones((_BLOCK, _BLOCK)), 1), x.dtype)
    inside = rows @ before
    totals = prefix_sum(inside[:, -1] + rows[:, -1])
    return (inside + totals[:, None]).reshape(-1)[: x.shape[0]]
