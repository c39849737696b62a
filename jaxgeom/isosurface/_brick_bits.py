"""Classify the bricks of a narrow band: as `_classify.py`, a word per row of nodes.

A row of 8 nodes along z owns 24 edges, 8 along each axis, and 8 cells: one word of 32
bits. Edges, faces and cells belong to the brick of their lowest node, so that what
bricks share is decided once.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int, UInt

from .._core import prefix_sum, stage
from ..fields import NarrowBand
from ._ambiguity import AbstractFaceRule, ambiguous
from ._bits import below, popcount
from ._classify import Counts, count_faces

SIZE = 8
ROWS = SIZE * SIZE
_LOW = (1 << SIZE) - 1
_EDGES = (1 << 3 * SIZE) - 1


class BrickBits(eqx.Module):
    """The signs, the edges and the cells of all bricks.

    - `inside`: [b, 9, 9], the signs of 9 nodes along z.
    - `words`: [64 b], per row the cut edges along x, y, z and the active cells, 8 bits
      each; `joined`: the faces whose inside corners are connected, by normal axis;
      `tunnels`: the cells through which the inside (lowest 8 bits) or the outside runs;
      None where that is never so.
    - `first_vertex`: [64 b], the number of the first vertex of every row.
    - `neighbors`: [8 b], where the bricks ahead are stored: entry c of a brick, c =
      x + 2 y + 4 z; b for bricks that are not.
    - `faces`: [b], how many each brick has.
    - `broken`: whether surface leaves the band for a brick that was left out.
    """

    inside: UInt[Array, "b n n"]
    words: UInt[Array, " m"]
    joined: UInt[Array, " m"] | None
    tunnels: UInt[Array, " m"] | None
    first_vertex: Int[Array, " m"]
    neighbors: Int[Array, " k"]
    faces: Int[Array, " b"]
    finite: Bool[Array, ""]
    broken: Bool[Array, ""]
    needed: Counts

    def step(self, word, bit, dx, dy, dz):
        """The row and the bit of the node (dx, dy, dz) further, each 0 or 1."""
        x, y, z = (word >> 3 & 7) + dx, (word & 7) + dy, bit + dz
        ahead = x >> 3 | y >> 3 << 1 | z >> 3 << 2
        brick = self.neighbors.at[(word >> 6) * 8 + ahead].get(mode="clip")
        return brick * ROWS + (x & 7) * SIZE + (y & 7), z & 7

    def vertex(self, word, bit, axis):
        """The number of the vertex on an edge, from the row of its lower node."""
        before = below(axis * SIZE + bit)
        edges = self.words.at[word].get(mode="clip") & before
        return self.first_vertex.at[word].get(mode="clip") + popcount(edges)


def cut_edges(words):
    """The bits of the cut edges: 8 along x, 8 along y, 8 along z."""
    return words & jnp.uint32(_EDGES)


def active_cells(words):
    """The bits of the cells that hold surface."""
    return words >> 3 * SIZE


def classify_bricks(
    band: NarrowBand, rule: AbstractFaceRule, token: Bool[Array, ""] | None
) -> BrickBits:
    """The bits of a band, and the numbering that follows from them."""
    real = band.mask()
    ahead = stage(token, _bricks_ahead, band)
    own, finite = stage(token, _signs, band.values, real)
    inside = stage(token, _agreed, own, ahead)
    gaps = stage(token, _gaps, inside, band, ahead, real)
    exist = _exist(band, real)
    words, unclear, corners = stage(token, _words, inside, exist, gaps)
    faces = stage(token, _faces, corners, words)
    joined, tunnels = _decided(rule, band.values, token)
    if joined is not None:
        joined = joined & unclear
        # A join leaves at most one loop fewer, two triangles more, in either cell.
        faces = faces + 4 * _per_brick(joined)
    if tunnels is not None:
        tunnels = tunnels & (active_cells(words) * jnp.uint32(1 + (1 << SIZE)))
        # A tube between two loops has four triangles more than two discs.
        faces = faces + 4 * _per_brick(tunnels)
    vertices = popcount(cut_edges(words))
    total = lambda x: jnp.sum(x, dtype=jnp.int32)
    cells = total(popcount(active_cells(words)))
    needed = Counts(total(vertices), total(faces), cells)
    return BrickBits(
        inside,
        words,
        joined,
        tunnels,
        stage(token, prefix_sum, vertices),
        ahead.reshape(-1),
        faces,
        finite,
        jnp.any(gaps),
        needed,
    )


def _per_brick(words):
    """The number of bits of every brick."""
    return jnp.sum(popcount(words).reshape(-1, ROWS), axis=1)


def _bricks_ahead(band):
    """[b, 8] where the bricks at (0 or 1, 0 or 1, 0 or 1) further are stored."""
    size = band.bricks.shape[0]
    own = jnp.arange(size, dtype=jnp.int32)
    steps = [np.array([c & 1, c >> 1 & 1, c >> 2], np.int32) for c in range(1, 8)]
    return jnp.stack([own, *(band.find(band.bricks + s) for s in steps)], axis=1)


def _signs(values, real):
    """[b, 9, 9] the inside nodes along z as bits; whether all samples are finite."""
    finite = jnp.isfinite(values)
    inside = (values < 0) & finite & real[:, None, None, None]
    shift = jnp.arange(SIZE + 1, dtype=jnp.uint32)
    rows = jnp.sum(inside.astype(jnp.uint32) << shift, axis=-1, dtype=jnp.uint32)
    return rows.astype(jnp.uint16), jnp.all(finite | ~real[:, None, None, None])


def _agreed(rows, ahead):
    """The signs of shared nodes as their owner has them, where it is stored.

    Two bricks may round the value of one node differently.
    """
    out = rows
    for c in range(1, 8):
        x, y, z = c & 1, c >> 1 & 1, c >> 2
        there = (slice(None), *(0 if one else slice(SIZE) for one in (x, y)))
        here = (slice(None), *(SIZE if one else slice(SIZE) for one in (x, y)))
        owned = rows[there].at[ahead[:, c]].get(mode="fill", fill_value=0)
        mask = jnp.uint16(1 << SIZE if z else _LOW)
        new = (owned & jnp.uint16(_LOW)) << (SIZE * z) & mask
        known = (ahead[:, c] < rows.shape[0]).reshape(-1, *[1] * (new.ndim - 1))
        old = out[here]
        out = out.at[here].set(jnp.where(known, old & ~mask | new, old))
    return out


def _gaps(inside, band, ahead, real):
    """[b, 8] the bricks ahead that are missed: surface enters them, or may."""
    size = ahead.shape[0]
    every = jnp.uint16(2 * _LOW + 1)
    out = [jnp.zeros(size, bool)]
    shape = np.array(band.grid.shape)
    for c in range(1, 8):
        step = np.array([c & 1, c >> 1 & 1, c >> 2], np.int32)
        x, y = (slice(SIZE, None) if one else slice(None) for one in step[:2])
        rows = inside[:, x, y].reshape(size, -1)
        bits = jnp.uint16(1 << SIZE) if c >> 2 else every
        none, full = (
            jnp.all(rows & bits == 0, axis=1),
            jnp.all(~rows & bits == 0, axis=1),
        )
        exists = jnp.all(SIZE * (band.bricks + step) < shape, axis=1)
        out.append(~(none | full) & exists & (ahead[:, c] == size) & real)
    return jnp.stack(out, axis=1)


def _exist(band, real):
    """(edges, faces, cells) of the grid, as the bits that rows have for them.

    Bricks on the last sides of the grid reach beyond it.
    """
    left = jnp.clip(np.array(band.grid.shape) - SIZE * band.bricks, 0, SIZE + 1)
    left = jnp.where(real[:, None], left, 0)
    within = [[_within(left, d, less) for less in (0, 1)] for d in range(3)]
    # Edges, faces and cells have an extent (1) along some axes, none along others.
    exist = lambda *extent: (
        within[0][extent[0]] & within[1][extent[1]] & within[2][extent[2]]
    )
    edges = _triple(exist(1, 0, 0), exist(0, 1, 0), exist(0, 0, 1))
    faces = _triple(exist(0, 1, 1), exist(1, 0, 1), exist(1, 1, 0))
    return edges, faces, exist(1, 1, 1)


def _within(left, axis, less):
    """The bits [b, 8, 8] of rows whose place along an axis is below left - less."""
    limit = left[:, axis, None, None] - less
    if axis == 2:
        return jnp.broadcast_to(
            below(jnp.clip(limit, 0, SIZE)), (len(left), SIZE, SIZE)
        )
    place = jnp.arange(SIZE)[:, None] if axis == 0 else jnp.arange(SIZE)
    return jnp.where(place < limit, jnp.uint32(_LOW), jnp.uint32(0))


def _triple(x, y, z):
    """Three times 8 bits in one word."""
    return x | y << SIZE | z << 2 * SIZE


def _words(inside, exist, gaps):
    """The words of all rows, the ambiguous faces, the signs of the cells' corners."""
    edges, faces, cells = exist
    rows = inside.astype(jnp.uint32)
    corner = lambda x, y, z: rows[:, x : x + SIZE, y : y + SIZE] >> z & jnp.uint32(_LOW)
    corners = [corner(c & 1, c >> 1 & 1, c >> 2) for c in range(8)]
    cut = _triple(*(corners[0] ^ corners[1 << axis] for axis in range(3))) & edges
    some, every = corners[0], corners[0]
    for word in corners[1:]:
        some, every = some | word, every & word
    active = some & ~every & cells & ~_beside(gaps)
    rings = [(0, 2, 6, 4), (0, 4, 5, 1), (0, 1, 3, 2)]
    unclear = [ambiguous([corners[c] for c in ring]) for ring in rings]
    return (
        (cut | active << 3 * SIZE).reshape(-1),
        (_triple(*unclear) & faces).reshape(-1),
        [c.reshape(-1) for c in corners],
    )


def _beside(gaps):
    """The cells [b, 8, 8] that would need edges of bricks that are missing."""
    last = jnp.arange(SIZE) == SIZE - 1
    out = jnp.zeros((gaps.shape[0], SIZE, SIZE), jnp.uint32)
    for c in range(1, 8):
        x = last if c & 1 else jnp.ones(SIZE, bool)
        y = last if c >> 1 & 1 else jnp.ones(SIZE, bool)
        z = jnp.uint32(1 << (SIZE - 1) if c >> 2 else _LOW)
        chosen = gaps[:, c, None, None] & x[:, None] & y
        out = out | jnp.where(chosen, z, jnp.uint32(0))
    return out


def _faces(corners, words):
    """The number of triangles of every brick (without a decider)."""
    split = lambda w: w.reshape(-1, ROWS)
    cells = split(active_cells(words))
    return jax.vmap(count_faces)([split(c) for c in corners], cells)


def _decided(rule, values, token):
    """The faces that the rule connects and its tunnels, by rows; None for none."""
    zero = jnp.zeros((), values.dtype)
    one = lambda v: rule(v, zero, None)
    found = jax.eval_shape(one, values[0])
    if not jax.tree.leaves(found):
        return None, None
    # Each brick is packed into words of 32 along z; the first 8 bits are its own.
    bits = stage(token, lambda v: lax.map(one, v, batch_size=64), values)
    return _rows(bits.joined), _rows(bits.tunnels)


def _rows(words) -> UInt[Array, " m"] | None:
    """The bits of rows, 8 for each of the kinds that the second axis counts."""
    if words is None:
        return None
    own = words[:, :, :SIZE, :SIZE, 0] & jnp.uint32(_LOW)
    kinds = [own[:, k].reshape(-1) << SIZE * k for k in range(own.shape[1])]
    return functools.reduce(jnp.bitwise_or, kinds)
