"""Between points and grid nodes, in node indices q = (x - origin) / spacing.

`interpolate` is the matrix W of trilinear weights (8 nodes a point), `splat` its
transpose, and `splat_gradient` spreads a vector at a point by the gradient of the
quadratic B-spline (27 nodes). One flat gather or scatter per node offset: under XLA on
the CPU several times faster than a single one of shape [n, 8]. Scatters run in a loop
over the offsets, since each takes a third of a second to compile.
"""

import itertools
import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

Shape = tuple[int, int, int]


@jax.jit
def interpolate(
    values: Float[Array, "x y z"], q: Float[Array, "n 3"]
) -> Float[Array, " n"]:
    """The trilinear interpolant of `values` at node indices q, clamped to the grid."""
    flat = values.reshape(-1)
    return sum(
        flat.at[index].get(mode="promise_in_bounds") * weight
        for index, weight in _trilinear(q, values.shape)
    )


@partial(jax.jit, static_argnames="shape")
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
    bases, fractions = _cells(q, shape)
    first = _flat_index(bases, shape)

    def add_corner(corner, flat):
        offset = (corner // 4, corner // 2 % 2, corner % 2)
        share = weights
        for end, t in zip(offset, fractions, strict=True):
            share = share * jnp.where(end == 1, t, 1 - t)
        return _add(flat, first + _flat_index(offset, shape), share)

    flat = _flat(onto, shape, weights.dtype)
    return lax.fori_loop(0, 8, add_corner, flat).reshape(shape)


@partial(jax.jit, static_argnames="shape")
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
    axes = [_quadratic(q[:, d], n) for d, n in enumerate(shape)]
    first = _flat_index([base for base, *_ in axes], shape)

    def add_node(node, flat):
        offset = (node // 9, node // 3 % 3, node % 3)
        w = [weights[i] for i, (_, weights, _) in zip(offset, axes, strict=True)]
        g = [slopes[i] for i, (_, _, slopes) in zip(offset, axes, strict=True)]
        value = (
            vectors[:, 0] * g[0] * w[1] * w[2]
            + vectors[:, 1] * w[0] * g[1] * w[2]
            + vectors[:, 2] * w[0] * w[1] * g[2]
        )
        return _add(flat, first + _flat_index(offset, shape), value)

    flat = _flat(onto, shape, vectors.dtype)
    return lax.fori_loop(0, 27, add_node, flat).reshape(shape)


def _flat(onto, shape, dtype):
    return jnp.zeros(math.prod(shape), dtype) if onto is None else onto.reshape(-1)


def _add(flat, index, values):
    return flat.at[index].add(values, mode="promise_in_bounds")


def _flat_index(index, shape):
    return (index[0] * shape[1] + index[1]) * shape[2] + index[2]


def _cells(q, shape):
    """The first nodes of the cells that hold the points, and where in them."""
    bases, fractions = [], []
    for d, n in enumerate(shape):
        clamped = jnp.clip(q[:, d], 0, n - 1)
        base = jnp.clip(jnp.floor(clamped).astype(jnp.int32), 0, n - 2)
        bases.append(base)
        fractions.append(clamped - base)
    return bases, fractions


def _trilinear(q, shape):
    """The 8 pairs (flat node index, weight) of the cells that hold the points."""
    bases, fractions = _cells(q, shape)
    pairs = [(1 - t, t) for t in fractions]
    for i, j, k in itertools.product((0, 1), repeat=3):
        index = _flat_index((bases[0] + i, bases[1] + j, bases[2] + k), shape)
        yield index, pairs[0][i] * pairs[1][j] * pairs[2][k]


def _quadratic(q, n):
    """The first of 3 nodes, the quadratic B-spline at them [3, n], its derivative."""
    center = jnp.clip(jnp.round(q).astype(jnp.int32), 1, n - 2)
    t = q - center
    weights = jnp.stack([0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2])
    return center - 1, weights, jnp.stack([t - 0.5, -2 * t, t + 0.5])
