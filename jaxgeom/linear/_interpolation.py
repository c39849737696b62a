"""Between points and grid nodes, in node indices q = (x - origin) / spacing.

`interpolate` is the matrix W of trilinear weights (8 nodes a point), `splat` its
transpose, and `splat_gradient` spreads a vector at a point by the gradient of the
quadratic B-spline (27 nodes). One flat gather or scatter per node offset: under XLA on
the CPU several times faster than a single one of shape [n, 8].
"""

import itertools
import math

import jax.numpy as jnp
from jaxtyping import Array, Float

Shape = tuple[int, int, int]


def interpolate(
    values: Float[Array, "x y z"], q: Float[Array, "n 3"]
) -> Float[Array, " n"]:
    """The trilinear interpolant of `values` at node indices q, clamped to the grid."""
    flat = values.reshape(-1)
    return sum(
        flat.at[index].get(mode="promise_in_bounds") * weight
        for index, weight in _trilinear(q, values.shape)
    )


def splat(
    weights: Float[Array, " n"],
    q: Float[Array, "n 3"],
    shape: Shape,
    *,
    onto: Float[Array, "x y z"] | None = None,
) -> Float[Array, "x y z"]:
    """W^T weights: every weight is shared among the 8 nodes around its point.

    `onto`: values of that shape that the shares are added to; zero by default.
    """
    flat = _flat(onto, shape, weights.dtype)
    for index, share in _trilinear(q, shape):
        flat = flat.at[index].add(share * weights, mode="promise_in_bounds")
    return flat.reshape(shape)


def splat_gradient(
    vectors: Float[Array, "n 3"],
    q: Float[Array, "n 3"],
    shape: Shape,
    *,
    onto: Float[Array, "x y z"] | None = None,
) -> Float[Array, "x y z"]:
    """sum_p v_p . grad K(q_p - i) at every node i, K the tensor quadratic B-spline.

    This is the weak divergence of the vector field that has v_p smeared by K, the right
    side of the Poisson equation in Kazhdan et al. (2006). Points must lie at least half
    a cell inside the outermost nodes. `onto` as for `splat`.
    """
    flat = _flat(onto, shape, vectors.dtype)
    axes = [_quadratic(q[:, d], n) for d, n in enumerate(shape)]
    (bx, wx, gx), (by, wy, gy), (bz, wz, gz) = axes
    for i, j, k in itertools.product(range(3), repeat=3):
        index = ((bx + i) * shape[1] + by + j) * shape[2] + bz + k
        value = (
            vectors[:, 0] * gx[i] * wy[j] * wz[k]
            + vectors[:, 1] * wx[i] * gy[j] * wz[k]
            + vectors[:, 2] * wx[i] * wy[j] * gz[k]
        )
        flat = flat.at[index].add(value, mode="promise_in_bounds")
    return flat.reshape(shape)


def _flat(onto, shape, dtype):
    return jnp.zeros(math.prod(shape), dtype) if onto is None else onto.reshape(-1)


def _trilinear(q, shape):
    """The 8 pairs (flat node index, weight) of the cells that hold the points."""
    bases, fractions = [], []
    for d, n in enumerate(shape):
        clamped = jnp.clip(q[:, d], 0, n - 1)
        base = jnp.clip(jnp.floor(clamped).astype(jnp.int32), 0, n - 2)
        bases.append(base)
        fractions.append(clamped - base)
    pairs = [(1 - t, t) for t in fractions]
    for i, j, k in itertools.product((0, 1), repeat=3):
        index = ((bases[0] + i) * shape[1] + bases[1] + j) * shape[2] + bases[2] + k
        yield index, pairs[0][i] * pairs[1][j] * pairs[2][k]


def _quadratic(q, n):
    """The first of 3 nodes, the quadratic B-spline at them, and its derivative."""
    center = jnp.clip(jnp.round(q).astype(jnp.int32), 1, n - 2)
    t = q - center
    weights = (0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2)
    return center - 1, weights, (t - 0.5, -2 * t, t + 0.5)
