"""Sets of grid nodes as bits, and lists made from them by counting instead of search.

32 nodes along the last axis share one unsigned word, so that everything that looks at
the whole grid looks at 1/32 of the data. A list is compacted by rank: the place of a
set bit is the number of set bits before it.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int, UInt

from .._core import prefix_sum, stage

WORD = 32


def pack(bits: Bool[Array, "*s n"]) -> UInt[Array, "*s w"]:
    """The booleans of the last axis as words of 32, the first in the lowest bit."""
    return pack_lanes(bits, WORD)


def pack_lanes(lanes: Array, width: int) -> UInt[Array, "*s w"]:
    """The sums of `width` neighbors on the last axis, neighbor i shifted by i bits."""
    padding = [(0, 0)] * (lanes.ndim - 1) + [(0, -lanes.shape[-1] % width)]
    if padding[-1][1]:
        lanes = jnp.pad(lanes, padding)
    rows = lanes.reshape(*lanes.shape[:-1], -1, width).astype(jnp.uint32)
    shifted = rows << jnp.arange(width, dtype=jnp.uint32)
    return jnp.sum(shifted, axis=-1, dtype=jnp.uint32)


def popcount(words: UInt[Array, "*s"]) -> Int[Array, "*s"]:
    """The number of set bits in each word."""
    return lax.population_count(words).astype(jnp.int32)


def below(bit: Int[Array, "*s"]) -> UInt[Array, "*s"]:
    """The word whose bits before `bit` are set."""
    return (jnp.uint32(1) << bit.astype(jnp.uint32)) - jnp.uint32(1)


def select(words: UInt[Array, "*s"], rank: Int[Array, "*s"]) -> Int[Array, "*s"]:
    """The position of the set bit number `rank` (from 0) of each word."""
    position = jnp.zeros_like(rank)
    for width in (16, 8, 4, 2, 1):
        low = popcount(words & jnp.uint32((1 << width) - 1))
        high = rank >= low
        rank = jnp.where(high, rank - low, rank)
        words = jnp.where(high, words >> width, words)
        position = jnp.where(high, position + width, position)
    return position


class Owners(eqx.Module):
    """For each of `capacity` slots: which owner it belongs to, and its place there."""

    owner: Int[Array, " k"]
    place: Int[Array, " k"]


def expand(
    counts: Int[Array, " m"],
    starts: Int[Array, " m"],
    capacity: int,
    token: Bool[Array, ""] | None = None,
) -> Owners:
    """Slot k belongs to the owner whose run starts[i] <= k < starts[i] + counts[i].

    One flag per run, packed to words: the number of flags up to k is the number of the
    run. Slots past the end belong to the last run; mask them.
    """
    owners = stage(token, lambda c: _nonempty(c > 0, capacity), counts)
    runs = stage(token, lambda c, s: _runs(c > 0, s, capacity), counts, starts)
    return stage(token, _owners, owners, runs, starts)


def expand_filled(
    starts: Int[Array, " m"],
    real: Bool[Array, " m"],
    capacity: int,
    token: Bool[Array, ""] | None = None,
) -> Owners:
    """`expand` for owners of which the first, those with `real`, have each a slot."""
    runs = stage(token, lambda r, s: _runs(r, s, capacity), real, starts)
    return stage(token, _owners, None, runs, starts)


def _owners(owners, runs, starts):
    owner = jnp.minimum(runs, starts.shape[0] - 1)
    if owners is not None:
        owner = owners.at[jnp.minimum(runs, owners.shape[0] - 1)].get(
            mode="promise_in_bounds"
        )
    slots = jnp.arange(runs.shape[0], dtype=jnp.int32)
    first = starts.at[owner].get(mode="promise_in_bounds")
    return Owners(owner, slots - first)


def _nonempty(filled, capacity):
    """The indices of the set flags, at most `capacity` of them."""
    size = min(capacity, filled.shape[0])
    place = prefix_sum(filled.astype(jnp.int32))
    indices = jnp.arange(filled.shape[0], dtype=jnp.int32)
    out = jnp.zeros(size, jnp.int32)
    return out.at[jnp.where(filled, place, size)].set(indices, mode="drop")


def _runs(filled, starts, capacity):
    """The number of the run that holds each slot."""
    flags = jnp.zeros(capacity, bool)
    flags = flags.at[jnp.where(filled, starts, capacity)].set(True, mode="drop")
    words = pack(flags)
    before = prefix_sum(popcount(words))
    up_to = (jnp.uint32(2) << jnp.arange(WORD, dtype=jnp.uint32)) - jnp.uint32(1)
    ranks = before[:, None] + popcount(words[:, None] & up_to) - 1
    return jnp.maximum(ranks.reshape(-1)[:capacity], 0)
