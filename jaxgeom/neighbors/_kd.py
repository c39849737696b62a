"""Exact neighbors by a balanced k-d tree: the default, on every device."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import prefix_sum
from ._backends import AbstractBackend, AbstractIndex, usable
from ._groups import kd_groups
from ._nearest import FEW, LANES, Boxes, packed, search_nearest
from ._tree import child_boxes, grow

_LEAF, _PACKET = 8, 8


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
        if k > FEW and groups.shape[1] <= _PACKET:
            # To compare costs most here: packets should be compact.
            rows, count = groups, jnp.asarray(groups.shape[0], jnp.int32)
        else:
            rows, count = _in_packets(groups.reshape(-1), active)
        # The next number up, so that strictly nearer includes what lies at the limit;
        # not a subnormal one, which processors take for zero.
        limit = jnp.nextafter(reach, jnp.asarray(jnp.inf, reach.dtype))
        limit = jnp.maximum(limit, jnp.finfo(limit.dtype).tiny)
        limits = jnp.where(active & (reach >= 0), limit, -1)
        found = search_nearest(self.boxes, packed(queries, rows, limits, count), k)
        items = self.groups.reshape(-1).at[found.slots].get(mode="fill", fill_value=n)
        out = jnp.full((q, k), n, jnp.int32)
        return out.at[rows].set(jnp.moveaxis(items, 0, -1), mode="drop")


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


def _in_packets(order, active) -> tuple[Int[Array, "p g"], Int[Array, ""]]:
    """The active rows in `order`, in packets, the rest q; and how many of these.

    Packets are not filled where there are lanes for all of them: a few queries far from
    each other have little in common.
    """
    q = active.shape[0]
    wanted = active.at[order].get(mode="fill", fill_value=False)
    place, number = prefix_sum(wanted.astype(jnp.int32)), jnp.sum(wanted)
    group = jnp.clip(-(-number // LANES), 1, _PACKET).astype(jnp.int32)
    place = place // group * _PACKET + place % group
    packets = max(-(-order.size // _PACKET), min(LANES, order.size))
    place = jnp.where(wanted, place, packets * _PACKET)
    rows = jnp.full(packets * _PACKET, q, jnp.int32).at[place].set(order, mode="drop")
    return rows.reshape(packets, _PACKET), (-(-number // group)).astype(jnp.int32)
