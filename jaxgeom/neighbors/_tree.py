"""A tree of bounding boxes over anything small, and an exact search through it.

Items are sorted along a Morton curve, `leaf` successive ones make a leaf, and two nodes
make the next one: a complete binary tree that needs no pointers. Node h has the
children 2h and 2h + 1, and node 1 is the root.

Many queries descend at once, one per lane, nearer child first. What a lane has left for
later is one bit per level: set where the sibling of its ancestor may still matter. A
lane that has finished takes the next query, so that no lane waits for the slowest.
Nothing depends on the density of the items: this is the search that cannot fail.

Source: H. Afra, L. Szirmay-Kalos, Stackless multi-BVH traversal, 2014 (the bits);
T. Aila, S. Laine, Understanding the efficiency of ray traversal on GPUs, 2009 (the
queue of queries).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

# Steps down the tree for every test of a leaf, and rounds between two refills.
_DESCENTS = 4
_ROUNDS = 4


class Tree(eqx.Module):
    """Items in the order of the leaves (sentinel n), a box per node (axes first)."""

    order: Int[Array, " m"]
    low: Float[Array, "3 h"]
    high: Float[Array, "3 h"]
    leaf: int = eqx.field(static=True)

    @property
    def first_leaf(self) -> int:
        """The node of the first leaf."""
        return self.order.shape[0] // self.leaf


class Nearest(eqx.Module):
    """The k nearest items of every lane, nearest first: sentinel n, infinitely far."""

    squares: Float[Array, "k t"]
    items: Int[Array, "k t"]


def grow(order: Int[Array, " n"], mask, low, high, leaf: int) -> Tree:
    """The tree of the items in `order`; `mask`, `low`, `high` [n, 3] are per item."""
    n = order.shape[0]
    leaves = 1 << (-(-n // leaf) - 1).bit_length()
    order = jnp.where(mask[order], order, n)
    order = jnp.pad(order, (0, leaves * leaf - n), constant_values=n)
    corner = lambda x, fill: x.T.at[:, order].get(mode="fill", fill_value=fill)
    # A box without items is infinitely far from everything.
    levels = [
        (
            corner(low, jnp.inf).reshape(3, leaves, leaf).min(axis=2),
            corner(high, -jnp.inf).reshape(3, leaves, leaf).max(axis=2),
        )
    ]
    while levels[-1][0].shape[1] > 1:
        low, high = levels[-1]
        levels.append(
            (
                jnp.minimum(low[:, 0::2], low[:, 1::2]),
                jnp.maximum(high[:, 0::2], high[:, 1::2]),
            )
        )
    nobody = jnp.full((3, 1), jnp.inf, levels[0][0].dtype)
    low, high = (
        jnp.concatenate([sign * nobody, *(level[i] for level in levels[::-1])], axis=1)
        for i, sign in enumerate((1, -1))
    )
    return Tree(order, low, high, leaf)


class _Lanes(eqx.Module):
    """Where every lane is: its query, its node (0: finished), what is left."""

    row: Int[Array, " t"]
    node: Int[Array, " t"]
    trail: Int[Array, " t"]
    point: Float[Array, "3 t"]
    best: Nearest


def search_tree(
    tree: Tree,
    queries: Float[Array, "q 3"],
    limits: Float[Array, " q"],
    queue: tuple[Int[Array, " q"], Int[Array, ""]],
    squares: Callable,
    *,
    k: int,
    lanes: int,
) -> Nearest:
    """The k items nearest to queries, with squared distance up to `limits` [q].

    **Arguments:**

    - `queue`: rows of the queries to search, best along a curve, and how many of them.
    - `squares`: (slots [leaf, t], points [3, t]) -> squared distances [leaf, t] to the
      items in these slots of `tree.order`; it must not be less than the distance to a
      box that holds the item. Slots of the sentinel may give anything.
    """
    n, q = tree.order.shape[0], queries.shape[0]
    rows, count = queue[0], queue[1].astype(jnp.int32)
    lanes = min(lanes, q)
    # The next number up, so that strictly nearer includes what lies at the limit; not
    # a subnormal one, which processors take for zero.
    limits = jnp.nextafter(limits, jnp.asarray(jnp.inf, limits.dtype))
    limits = jnp.maximum(limits, jnp.finfo(limits.dtype).tiny)
    out = Nearest(
        jnp.full((k, q), jnp.inf, queries.dtype), jnp.full((k, q), n, jnp.int32)
    )
    idle = jnp.zeros(lanes, jnp.int32)
    blank = Nearest(out.squares[:, :lanes], out.items[:, :lanes])
    start = _Lanes(idle + q, idle, idle, jnp.zeros((3, lanes), queries.dtype), blank)

    def refill(lane, out, used):
        """Finished lanes hand in what they found and take the next queries."""
        done = lane.node == 0
        target = jnp.where(done, lane.row, q)
        put = lambda to, x: to.at[:, target].set(x, mode="drop")
        out = jax.tree.map(put, out, lane.best)
        place = used + jnp.cumsum(done, dtype=jnp.int32) - done
        row = jnp.where(place < count, rows.at[place].get(mode="fill", fill_value=q), q)
        row = jnp.where(done, row, lane.row)
        point = queries.T.at[:, row].get(mode="fill", fill_value=0)
        limit = limits.at[row].get(mode="fill", fill_value=0)
        fresh = lambda x, fill: jnp.where(done, fill, x)
        best = Nearest(fresh(lane.best.squares, limit), fresh(lane.best.items, n))
        node = fresh(lane.node, (row < q).astype(jnp.int32))
        trail = fresh(lane.trail, 0)
        used = jnp.minimum(used + jnp.sum(done, dtype=jnp.int32), count)
        return _Lanes(row, node, trail, point, best), out, used

    def rounds(carry):
        lane, out, used = refill(*carry)
        step = lambda _, lane: _visit(tree, _descend(tree, lane), squares)
        return jax.lax.fori_loop(0, _ROUNDS, step, lane), out, used

    busy = lambda c: (c[2] < count) | jnp.any(c[0].row < q)
    _, out, _ = jax.lax.while_loop(busy, rounds, (start, out, jnp.int32(0)))
    return Nearest(out.squares, tree.order.at[out.items].get(mode="fill", fill_value=n))


def _descend(tree: Tree, lane: _Lanes) -> _Lanes:
    """A few steps down, to the nearer child, or on to what was left for later."""
    worst = lane.best.squares[-1]

    def step(_, carry):
        node, trail = carry
        inner = (node > 0) & (node < tree.first_leaf)
        left = jnp.where(inner, 2 * node, 0)
        one = _box_squares(tree, left, lane.point)
        two = _box_squares(tree, left + 1, lane.point)
        down = left + (two < one)
        later = 2 * trail + (jnp.maximum(one, two) < worst)
        useful = jnp.minimum(one, two) < worst
        away, rest = next_node(node, trail)
        node = jnp.where(inner, jnp.where(useful, down, away), node)
        return node, jnp.where(inner, jnp.where(useful, later, rest), trail)

    node, trail = jax.lax.fori_loop(0, _DESCENTS, step, (lane.node, lane.trail))
    return _Lanes(lane.row, node, trail, lane.point, lane.best)


def _visit(tree: Tree, lane: _Lanes, squares: Callable) -> _Lanes:
    """Lanes that stand on a leaf take in its items and go on."""
    there = lane.node >= tree.first_leaf
    slot = jnp.where(there, (lane.node - tree.first_leaf) * tree.leaf, 0)
    slots = slot + jnp.arange(tree.leaf, dtype=jnp.int32)[:, None]
    found = squares(slots, lane.point)
    found = jnp.where(there & jnp.isfinite(found), found, jnp.inf)
    take = lambda j, best: insert(best, found[j], slots[j])
    best = jax.lax.fori_loop(0, tree.leaf, take, lane.best)
    node, trail = next_node(lane.node, lane.trail)
    return _Lanes(
        lane.row,
        jnp.where(there, node, lane.node),
        jnp.where(there, trail, lane.trail),
        lane.point,
        best,
    )


def next_node(node, trail):
    """The deepest sibling left for later, and what is left then; node 0 at the end."""
    up = jax.lax.population_count((trail & -trail) - 1)
    more = trail != 0
    up = jnp.where(more, up, 0)
    return jnp.where(more, (node >> up) ^ 1, 0), jnp.where(more, (trail >> up) ^ 1, 0)


def _box_squares(tree: Tree, node, point) -> Float[Array, " t"]:
    """A lower bound of the squared distance to what a node holds.

    Rounding is monotone, and so this is also below the rounded distances.
    """
    gap = lambda d: jnp.maximum(
        jnp.maximum(tree.low[d][node] - point[d], point[d] - tree.high[d][node]), 0
    )
    return sum(gap(d) ** 2 for d in range(3))


def insert(best: Nearest, square: Float[Array, " t"], item) -> Nearest:
    """The lists with one more candidate for every lane, `item` [t] or one for all.

    A row of the sorted list becomes the middle one of itself, the row before it and the
    newcomer. Equal distances keep their order.
    """
    if best.items.shape[0] == 1:
        closer = square < best.squares
        pick = lambda new, old: jnp.where(closer, new, old)
        return Nearest(pick(square, best.squares), pick(item, best.items))
    row_before = lambda x, fill: jnp.concatenate([jnp.full_like(x[:1], fill), x[:-1]])
    nearer = row_before(best.squares, -jnp.inf)
    squares = jnp.minimum(best.squares, jnp.maximum(nearer, square))
    moved = jnp.where(square < nearer, row_before(best.items, 0), item)
    return Nearest(squares, jnp.where(square < best.squares, moved, best.items))
