"""Packets of queries that walk a tree of boxes together.

Queries that lie together want nearly the same nodes. A packet of them reads every node
once, and computes with it side by side; all packets of a tile
step at the same time. What a packet has left for later is one bit per level (see
`_tree`), and a packet that has finished gives its place to the next one. Rows of a
table are read whole: a row is one copy, its entries alone would be gathers.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from ._tree import next_node

# Queries of a tile, steps down for every leaf, rounds to a refill.
_TILE = 4096
_DESCENTS = 3
_ROUNDS = 8


class AbstractVisit(eqx.Module):
    """What a packet does at the nodes.

    `inner` has a row for every inner node (number 0 is no node), `leaves` one for every
    leaf. Rows arrive as [t, 1] columns, channels of the queries and states as [t, p].
    """

    inner: eqx.AbstractVar[Float[Array, "h r"]]
    leaves: eqx.AbstractVar[Float[Array, "l w"]]

    @abstractmethod
    def wanted(self, row: list, query: list, state):
        """Who wants the left child, who the right one, and who the right one first."""

    def passed(self, row: list, query: list, state, left, right):
        """The state after a child that nobody wants was `left` or `right` [t, 1]."""
        return state

    @abstractmethod
    def taken(self, row: list, leaf: Int[Array, "t 1"], query: list, state):
        """The state after a leaf."""


class _Lanes(eqx.Module):
    """Where every packet is: its number, its node (0: finished), what is left."""

    packet: Int[Array, " t"]
    node: Int[Array, " t"]
    trail: Int[Array, " t"]
    query: Float[Array, "t c p"]
    state: PyTree[Array]


def walk(
    visit: AbstractVisit,
    queries: Float[Array, "q c"],
    groups: Int[Array, "g p"],
    start: PyTree[Array],
):
    """The states [q] after every query has walked the tree of `visit`.

    `groups` are the queries that lie together (q for none, last); `start` holds a state
    [q] for each, which those keep that are in no group.
    """
    # Places without a query double the first one of their packet.
    rows = jnp.where(groups < queries.shape[0], groups, groups[:, :1])
    count = jnp.sum(groups[:, 0] < queries.shape[0], dtype=jnp.int32)
    packed = lambda x: x.at[rows].get(mode="clip")
    waiting = jnp.swapaxes(packed(queries), 1, 2)
    final = _walk_all(visit, waiting, jax.tree.map(packed, start), count)
    put = lambda x, new: x.at[groups].set(new, mode="drop")
    return jax.tree.map(put, start, final)


def _walk_all(visit, waiting, fresh, count):
    """The states of the first `count` packets at the end, [packets, p]."""
    tile = min(_TILE // waiting.shape[2], waiting.shape[0])
    pick = lambda x, rows: x.at[rows].get(mode="promise_in_bounds")
    idle = jnp.zeros(tile, jnp.int32)
    blank = jax.tree.map(lambda x: x[:tile], (waiting, fresh))
    first = _Lanes(idle + count, idle, idle, *blank)

    def refill(lane, out, used):
        """Finished packets hand in their state and make room for the next ones."""
        done = lane.node == 0
        target = jnp.where(done, lane.packet, len(waiting))
        put = lambda to, x: to.at[target].set(x, mode="drop")
        out = jax.tree.map(put, out, lane.state)
        place = used + jnp.cumsum(done, dtype=jnp.int32) - done
        packet = jnp.where(done, jnp.minimum(place, count), lane.packet)
        row = jnp.minimum(packet, len(waiting) - 1)
        renew = lambda new, x: jnp.where(_as_rows(done, x), pick(new, row), x)
        node = jnp.where(done, (packet < count).astype(jnp.int32), lane.node)
        lane = _Lanes(
            packet,
            node,
            jnp.where(done, 0, lane.trail),
            renew(waiting, lane.query),
            jax.tree.map(renew, fresh, lane.state),
        )
        return lane, out, jnp.minimum(used + jnp.sum(done, dtype=jnp.int32), count)

    def rounds(carry):
        lane, out, used = refill(*carry)
        step = lambda _, lane: _read_leaf(visit, _descend(visit, lane))
        return jax.lax.fori_loop(0, _ROUNDS, step, lane), out, used

    busy = lambda c: (c[2] < count) | jnp.any(c[0].packet < count)
    return jax.lax.while_loop(busy, rounds, (first, fresh, jnp.int32(0)))[1]


def _descend(visit, lane: _Lanes) -> _Lanes:
    """A few steps down, to the child most want first, or on to what was left."""
    inner_nodes = visit.inner.shape[0]
    query = _channels(lane.query)
    fetch = lambda node: visit.inner.at[jnp.where(node < inner_nodes, node, 0)].get(
        mode="promise_in_bounds"
    )

    def step(_, carry):
        node, trail, row, state = carry
        columns = _channels(row[..., None])
        one, two, right = visit.wanted(columns, query, state)
        ones, twos, rights = _counts(one, two, right)
        inner = (node > 0) & (node < inner_nodes)
        left_out, right_out = (inner & (n == 0) for n in (ones, twos))
        state = visit.passed(
            columns, query, state, left_out[:, None], right_out[:, None]
        )
        both = (ones > 0) & (twos > 0)
        turn = jnp.where(both, 2 * rights > jnp.maximum(ones, twos), twos > 0)
        away, rest = next_node(node, trail)
        some = (ones > 0) | (twos > 0)
        down = jnp.where(some, 2 * node + turn, away)
        later = jnp.where(some, 2 * trail + both, rest)
        node, trail = jnp.where(inner, down, node), jnp.where(inner, later, trail)
        return node, trail, fetch(node), state

    carry = (lane.node, lane.trail, fetch(lane.node), lane.state)
    node, trail, _, state = jax.lax.fori_loop(0, _DESCENTS, step, carry)
    return _Lanes(lane.packet, node, trail, lane.query, state)


def _read_leaf(visit, lane: _Lanes) -> _Lanes:
    """Packets that stand on a leaf take it in and go on."""
    inner_nodes = visit.inner.shape[0]
    there = lane.node >= inner_nodes
    leaf = jnp.where(there, lane.node - inner_nodes, 0)
    row = visit.leaves.at[leaf].get(mode="promise_in_bounds")
    new = visit.taken(
        _channels(row[..., None]), leaf[:, None], _channels(lane.query), lane.state
    )
    state = jax.tree.map(
        lambda x, y: jnp.where(_as_rows(there, x), x, y), new, lane.state
    )
    away, rest = next_node(lane.node, lane.trail)
    node = jnp.where(there, away, lane.node)
    trail = jnp.where(there, rest, lane.trail)
    return _Lanes(lane.packet, node, trail, lane.query, state)


def _counts(one: Bool[Array, "t p"], two, right):
    """How many of each packet: three sums in one, which XLA computes only once."""
    whole = lambda x, unit: x.astype(jnp.int32) * unit
    flags = whole(one, 1) + whole(two, 2**10) + whole(right, 2**20)
    total = jnp.sum(flags, axis=1)
    return total & 1023, (total >> 10) & 1023, total >> 20


def _channels(x: Float[Array, "t c *p"]) -> list:
    return [x[:, i] for i in range(x.shape[1])]


def _as_rows(flag, x):
    return flag.reshape(flag.shape + (1,) * (x.ndim - 1))
