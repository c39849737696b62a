"""The k nearest points of many queries, by packets that walk a tree of boxes.

A packet is a group of queries near each other. It goes where one of them may find
something nearer, to the nearer child first; at a leaf all of them are compared with all
the points. Many packets step at once, one per lane. What a lane has left for later is
one bit per level: set where the sibling of its ancestor may still matter. A lane that
has finished takes the next packet, so that none waits for the slowest. Nothing depends
on the density of the points.

Source: H. Afra, L. Szirmay-Kalos, Stackless multi-BVH traversal, 2014 (the bits);
T. Aila, S. Laine, Understanding the efficiency of ray traversal on GPUs, 2009 (the
queue).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ._tree import next_node

# Packets at a time: in a small tree, in a large one, with long lists. XLA on a CPU
# divides the steps among threads where they touch much memory, the tree included: then
# only wide ones are worth it, and otherwise narrow ones, which it leaves to one thread.
_LANES, _LANES_OF_LARGE, _LANES_OF_MANY = 32, 512, 128
# Numbers in the leaves of a large tree.
_LARGE = 2**16
# Steps down the tree for every leaf, leaves between two refills.
_DESCENTS = 6
_LEAVES = 4
# Lists of so few neighbors are written out row by row.
FEW = 4


class Nearest(eqx.Module):
    """The k nearest points of every query, nearest first: squared distance and slot."""

    squares: Float[Array, "k *q"]
    slots: Int[Array, "k *q"]


class Boxes(eqx.Module):
    """A tree as a search reads it: `inner` has a row for every inner node (number 0 is
    no node), the boxes of its children; `leaves` the x, the y and the z of their
    points, infinite where there is none."""

    inner: Float[Array, "h 12"]
    leaves: Float[Array, "l w"]


class Packets(eqx.Module):
    """Queries in groups of g; only points with a squared distance below `limits` are
    asked for. `count` of the packets are searched."""

    points: Float[Array, "p 3 g"]
    limits: Float[Array, "p g"]
    count: Int[Array, ""]


class _Lanes(eqx.Module):
    """Where every packet is: its number, its node (0: finished), what is left."""

    packet: Int[Array, " t"]
    node: Int[Array, " t"]
    trail: Int[Array, " t"]
    points: Float[Array, "3 g t"]
    best: Nearest


def lanes_for(boxes: Boxes, k: int) -> int:
    """How many packets are searched at a time."""
    if k > FEW:
        return _LANES_OF_MANY
    return _LANES_OF_LARGE if boxes.leaves.size > _LARGE else _LANES


def packed(queries, rows: Int[Array, "p g"], limits, count) -> Packets:
    """The packets of `rows` of queries [q, 3]; a row of q is nobody."""
    points = queries.T.at[:, rows].get(mode="fill", fill_value=0)
    limits = limits.at[rows].get(mode="fill", fill_value=-1)
    return Packets(jnp.moveaxis(points, 0, 1), limits, count)


def search_nearest(boxes: Boxes, packets: Packets, k: int) -> Nearest:
    """The k nearest points of every query of the packets [k, p, g].

    Slots count the points leaf by leaf; where there are fewer than k below the limit,
    the slot is that past the last.
    """
    number, group = packets.limits.shape
    slots = boxes.leaves.size // 3
    out = Nearest(
        jnp.zeros((k, number, group), packets.limits.dtype),
        jnp.full((k, number, group), slots, jnp.int32),
    )
    lanes = min(lanes_for(boxes, k), number)
    idle = jnp.zeros(lanes, jnp.int32)
    blank = lambda *shape: jnp.zeros((*shape, lanes), packets.limits.dtype)
    best = Nearest(blank(k, group), jnp.zeros((k, group, lanes), jnp.int32))
    first = _Lanes(idle + number, idle, idle, blank(3, group), best)

    def refill(lane, out, used):
        """Finished packets hand in what they found and make room for the next ones."""
        done = lane.node == 0
        target = jnp.where(done, lane.packet, number)
        put = lambda to, x: to.at[:, target].set(jnp.swapaxes(x, 1, 2), mode="drop")
        out = jax.tree.map(put, out, lane.best)
        place = used + jnp.cumsum(done, dtype=jnp.int32) - done
        fresh = done & (place < packets.count)
        packet = jnp.where(done, jnp.where(fresh, place, number), lane.packet)
        row = jnp.minimum(packet, number - 1)
        pick = lambda x: jnp.moveaxis(x.at[row].get(mode="promise_in_bounds"), 0, -1)
        renew = lambda new, x: jnp.where(done, new, x)
        limits = pick(packets.limits)
        best = Nearest(renew(limits, lane.best.squares), renew(slots, lane.best.slots))
        used = used + jnp.sum(fresh, dtype=jnp.int32)
        lane = _Lanes(
            packet,
            jnp.where(done, fresh.astype(jnp.int32), lane.node),
            renew(0, lane.trail),
            renew(pick(packets.points), lane.points),
            best,
        )
        return lane, out, used

    def rounds(carry):
        lane, out, used = refill(*carry)
        step = lambda _, lane: _visit(boxes, _descend(boxes, lane))
        return jax.lax.fori_loop(0, _LEAVES, step, lane), out, used

    busy = lambda c: (c[2] < packets.count) | jnp.any(c[0].packet < number)
    return jax.lax.while_loop(busy, rounds, (first, out, jnp.int32(0)))[1]


def _descend(boxes: Boxes, lane: _Lanes) -> _Lanes:
    """A few steps down, to the nearer child, or on to what was left for later."""
    inner_nodes = boxes.inner.shape[0]
    # A box bounds distances to its points, and so does its rounded square but for the
    # last digits.
    worst = lane.best.squares[-1]
    reach = worst * (1 + 4 * jnp.finfo(worst.dtype).eps)

    def wanted(node):
        """Carried to the next step, or XLA would compute it for each of its uses."""
        row = jnp.where(node < inner_nodes, node, 0)
        row = boxes.inner.at[row].get(mode="promise_in_bounds")
        return _wanted(row.T, lane.points, reach)

    def step(_, carry):
        node, trail, want = carry
        inner = (node > 0) & (node < inner_nodes)
        some, both, right = want > 0, want > 2, (want == 2) | (want == 4)
        down, later = 2 * node + right, 2 * trail + both
        away, rest = next_node(node, trail)
        pick = lambda a, b, old: jnp.where(inner, jnp.where(some, a, b), old)
        node, trail = pick(down, away, node), pick(later, rest, trail)
        return node, trail, wanted(node)

    carry = (lane.node, lane.trail, wanted(lane.node))
    node, trail, _ = jax.lax.fori_loop(0, _DESCENTS, step, carry)
    return eqx.tree_at(lambda x: (x.node, x.trail), lane, (node, trail))


def _wanted(row, points, reach):
    """What packets want of two children: 0 nothing, 1 the left one, 2 the right one, 3
    both, the left one first, 4 both, the right one first.

    Written out query by query, and in one number: XLA would compute a sum over the
    queries, and every result of its own, from the beginning and entry by entry.
    """
    one = two = False
    near = far = jnp.inf
    for g in range(points.shape[1]):
        left, right = _gap(row[:6], points[:, g]), _gap(row[6:], points[:, g])
        one, two = one | (left < reach[g]), two | (right < reach[g])
        near, far = _lesser(left, near), _lesser(right, far)
    both = one & two
    return jnp.where(both, 3 + (far < near), one + 2 * two).astype(jnp.int32)


def _visit(boxes: Boxes, lane: _Lanes) -> _Lanes:
    """Packets that stand on a leaf take in its points and go on."""
    first_leaf, size = boxes.inner.shape[0], boxes.leaves.shape[1] // 3
    there = lane.node >= first_leaf
    leaf = jnp.where(there, lane.node - first_leaf, 0)
    row = boxes.leaves.at[leaf].get(mode="promise_in_bounds").T.reshape(3, size, 1, -1)
    squares = sum((row[d] - lane.points[d]) ** 2 for d in range(3))
    squares = jnp.where(there, squares, jnp.inf)
    best = lane.best
    if best.slots.shape[0] <= FEW:
        for j in range(size):
            best = inserted(best, squares[j], leaf * size + j)
    else:
        # Written down once: XLA would compute it again for each of the k places.
        squares = jax.lax.optimization_barrier(squares)
        take = lambda j, best: _inserted_among_many(best, squares[j], leaf * size + j)
        best = jax.lax.fori_loop(0, size, take, best)
    away, rest = next_node(lane.node, lane.trail)
    return _Lanes(
        lane.packet,
        jnp.where(there, away, lane.node),
        jnp.where(there, rest, lane.trail),
        lane.points,
        best,
    )


def _gap(box, point):
    """The squared distances of points to boxes [6, t]."""
    outside = lambda d: _greater(box[d] - point[d], point[d] - box[d + 3])
    return sum(_greater(outside(d), 0) ** 2 for d in range(3))


def inserted(best: Nearest, square, slot) -> Nearest:
    """The sorted lists with one more candidate; equal distances keep their order."""
    squares, slots = [], []
    for r in range(best.slots.shape[0]):
        nearer = square < best.squares[r]
        if r == 0:
            value, item = square, slot
        else:
            before = square < best.squares[r - 1]
            value = jnp.where(before, best.squares[r - 1], square)
            item = jnp.where(before, best.slots[r - 1], slot)
        squares.append(jnp.where(nearer, value, best.squares[r]))
        slots.append(jnp.where(nearer, item, best.slots[r]))
    return Nearest(jnp.stack(squares), jnp.stack(slots))


def _inserted_among_many(best: Nearest, square, slot) -> Nearest:
    """The same, all places at once: the row before every row is the list, shifted."""
    shift = [(1, -1, 0), (0, 0, 0), (0, 0, 0)]
    row_before = lambda x, fill: jax.lax.pad(x, jnp.asarray(fill, x.dtype), shift)
    squares, slots = row_before(best.squares, -jnp.inf), row_before(best.slots, 0)
    before, nearer = square < squares, square < best.squares
    value, item = jnp.where(before, squares, square), jnp.where(before, slots, slot)
    return Nearest(
        jnp.where(nearer, value, best.squares), jnp.where(nearer, item, best.slots)
    )


# Comparisons and selections: the maxima of XLA take care of NaN, which costs twice.
def _greater(x, y):
    return jnp.where(x > y, x, y)


def _lesser(x, y):
    return jnp.where(x < y, x, y)
