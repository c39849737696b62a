"""Blocks of Morton-adjacent items with bounding boxes, and a pruned exact search.

Queries are searched in small tiles. A tile visits the blocks whose box may hold
something nearer than what some query of the tile already has, nearest box first.
Nothing depends on the density of the items: this is the search that cannot fail.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._morton import bounds, morton_order


class Blocks(eqx.Module):
    """Items permuted by `order` [c, size] (sentinel n), boxes [c, 3] per block."""

    order: Int[Array, "c size"]
    low: Float[Array, "c 3"]
    high: Float[Array, "c 3"]


def pack(order: Int[Array, " n"], mask: Bool[Array, " n"], low, high, size: int):
    """Blocks of `size` successive items; `mask`, `low`, `high` [n, 3] are per item."""
    n = order.shape[0]
    rows = -(-n // size)
    order = jnp.where(mask[order], order, n)
    order = jnp.pad(order, (0, rows * size - n), constant_values=n).reshape(rows, size)
    corner = lambda x, fill: x.at[order].get(mode="fill", fill_value=fill)
    return Blocks(
        order, corner(low, jnp.inf).min(axis=1), corner(high, -jnp.inf).max(axis=1)
    )


def pack_points(points, mask, size: int) -> Blocks:
    """Blocks of points, sorted here."""
    order, _, _ = morton_order(points, mask, *bounds(points, mask))
    return pack(order, mask, points, points, size)


def search_tile(queries, blocks: Blocks, state, visit: Callable, reach: Callable):
    """`state` after visiting every block that can matter to a tile of queries.

    `visit(state, block)` takes in one block; `reach(state)` [t] is the squared distance
    below which a query still wants items (minus infinity: nothing at all).
    """
    boundless = jnp.full(queries.shape[0], jnp.inf, queries.dtype)
    nearest = _least_keys(queries, blocks, boundless)
    wants = jnp.any(reach(state) >= 0)
    keys = jnp.where(wants & (blocks.low[:, 0] <= blocks.high[:, 0]), nearest, jnp.inf)

    def take(carry):
        state, keys = carry
        least = jnp.min(keys)
        # argmin is several times slower than two plain reductions.
        row = jnp.arange(keys.shape[0], dtype=jnp.int32)
        block = jnp.min(jnp.where(keys == least, row, keys.shape[0] - 1))
        box = _box_squares(queries, blocks.low[block][None], blocks.high[block][None])
        useful = jnp.any(box[:, 0] <= reach(state))
        state = jax.lax.cond(useful, lambda s: visit(s, block), lambda s: s, state)
        return state, keys.at[block].set(jnp.inf)

    # First until every query has some bound, then only what the bounds let through.
    open_ended = lambda c: jnp.any(reach(c[0]) == jnp.inf) & (jnp.min(c[1]) < jnp.inf)
    state, keys = jax.lax.while_loop(open_ended, take, (state, keys))
    useful = _least_keys(queries, blocks, reach(state))
    keys = jnp.where(useful < jnp.inf, keys, jnp.inf)
    within = lambda c: (
        (jnp.min(c[1]) < jnp.inf) & (jnp.min(c[1]) <= jnp.max(reach(c[0])))
    )
    return jax.lax.while_loop(within, take, (state, keys))[0]


def _least_keys(queries, blocks: Blocks, limits) -> Float[Array, " c"]:
    """The least squared distance of each box to the queries it is within reach of."""

    # A loop over queries of plain vector operations: XLA does not vectorise the
    # reduction of a [t, c] table over its first axis.
    def step(i, keys):
        square = _box_squares(queries[i][None], blocks.low, blocks.high)[0]
        return jnp.minimum(keys, jnp.where(square <= limits[i], square, jnp.inf))

    start = jnp.full(blocks.low.shape[0], jnp.inf, queries.dtype)
    return jax.lax.fori_loop(0, queries.shape[0], step, start)


def _box_squares(queries, low, high) -> Float[Array, "t c"]:
    """A lower bound of the squared distance of every query to every box."""

    def gap(d):
        q = queries[:, d, None]
        return jnp.maximum(jnp.maximum(low[:, d] - q, q - high[:, d]), 0)

    # Rounding must never raise the bound above the distance of an item inside.
    safety = 1 - 8 * jnp.finfo(queries.dtype).eps
    return sum(gap(d) ** 2 for d in range(3)) * safety
