"""Exact neighbors by a balanced k-d tree: the default, on every device."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import prefix_sum
from ._backends import AbstractBackend, AbstractIndex, usable
from ._groups import kd_groups
from ._nearest import FEW, Boxes, lanes_for, packed, search_nearest
from ._tree import child_boxes, grow

_LEAF, _PACKET, _SMALL_PACKET = 8, 8, 4


class KdIndex(AbstractIndex):
    """Points in groups, which are the leaves of a tree."""

    points: Float[Array, "n 3"]
    mask: Bool[Array, " n"]
    groups: Int[Array, "g s"]
    boxes: Boxes

    # Outside jit, control flow compiles what it closes over as constants, anew at
    # every call, and XLA spends most of a minute folding them.
    @eqx.filter_jit
    def search(self, queries, active, k, reach, groups):
        n, q = self.points.shape[0], queries.shape[0]
        if groups is None:
            groups = kd_groups(queries, active, _PACKET)
        order = groups.reshape(-1)
        if k > FEW:
            ways = [_in_small_packets(order, q)]
        else:
            ways = _in_packets(order, active, lanes_for(self.boxes, k))
        # The next number up, so that strictly nearer includes what lies at the limit;
        # not a subnormal one, which processors take for zero.
        limit = jnp.nextafter(reach, jnp.asarray(jnp.inf, reach.dtype))
        limit = jnp.maximum(limit, jnp.finfo(limit.dtype).tiny)
        limits = jnp.where(active & (reach >= 0), limit, -1)
        points, out = self.groups.reshape(-1), jnp.full((q, k), n, jnp.int32)
        for rows, count in ways:
            found = search_nearest(self.boxes, packed(queries, rows, limits, count), k)
            items = points.at[found.slots].get(mode="fill", fill_value=n)
            out = out.at[rows].set(jnp.moveaxis(items, 0, -1), mode="drop")
        return out


class KdTree(AbstractBackend):
    """A balanced tree of boxes, searched by packets of queries."""

    @eqx.filter_jit
    def build(self, points, mask):
        clean, real = usable(points, mask)
        groups = kd_groups(clean, real, _LEAF)
        leaves = clean.at[groups].get(mode="fill", fill_value=jnp.inf)
        leaves = leaves.swapaxes(1, 2).reshape(groups.shape[0], -1)
        boxes = Boxes(child_boxes(grow(groups, clean, clean)), leaves)
        return KdIndex(points, mask, groups, boxes)


def _in_packets(
    order, active, lanes: int
) -> list[tuple[Int[Array, "p g"], Int[Array, ""]]]:
    """The active rows in `order`, as packets of one if they are few, and as larger ones
    if they are many (one of the two is empty): rows, q for none, and how many packets.

    Packets are not filled where there are lanes for more of them: queries far from each
    other have little in common.
    """
    q = active.shape[0]
    wanted = active.at[order].get(mode="fill", fill_value=False)
    place, number = prefix_sum(wanted.astype(jnp.int32)), jnp.sum(wanted)
    few = number <= lanes

    def packets(use, group, shape):
        """`group` of the rows in each packet of shape[1]."""
        to = place // group * shape[1] + place % group
        to = jnp.where(wanted & use, to, shape[0] * shape[1])
        rows = (
            jnp.full(shape[0] * shape[1], q, jnp.int32).at[to].set(order, mode="drop")
        )
        count = jnp.where(use, -(-number // group), 0).astype(jnp.int32)
        return rows.reshape(shape), count

    singles = packets(few, 1, (min(lanes, order.size), 1))
    if order.size <= lanes:
        return [singles]
    group = jnp.clip(-(-number // lanes), 1, _PACKET).astype(jnp.int32)
    shape = (max(-(-order.size // _PACKET), lanes), _PACKET)
    return [singles, packets(~few, group, shape)]


def _in_small_packets(order, q: int) -> tuple[Int[Array, "p g"], Int[Array, ""]]:
    """All rows in `order`, a few in a packet: where lists are long, to compare costs
    most, and compact packets meet fewer points."""
    short = -order.size % _SMALL_PACKET
    rows = jnp.pad(order, (0, short), constant_values=q).reshape(-1, _SMALL_PACKET)
    return rows, jnp.asarray(rows.shape[0], jnp.int32)
