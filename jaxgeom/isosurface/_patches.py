"""Find the surface patches of all active cells, and number the vertices of the dual.

Cells are found by rank like everything here; a cell has a vertex for each of its
patches, numbered in the order of the cells.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._core import prefix_sum, stage
from ._ambiguity import ambiguous
from ._bits import WORD, Owners, expand, popcount, select
from ._classify import Bits, Counts, Numbers, corner_words
from ._cube import edges, faces
from ._extraction import Capacity
from ._faces import corner_signs, edge_rank
from ._patch_tables import FLIPPED, NO_FACE, REAL, patch_tables
from ._vertices import coordinates

_BIT = WORD.bit_length() - 1


class PatchCells(eqx.Module):
    """Active cells: word and bit of the lower corner, the row of the patch tables, and
    the number of the first vertex."""

    word: Int[Array, " c"]
    bit: Int[Array, " c"]
    row: Int[Array, " c"]
    first: Int[Array, " c"]
    num_vertices: Int[Array, ""]


class Patches(eqx.Module):
    """The patch of every dual vertex: its cell, and its edges.

    - `node`: the flat index of the lower corner of the cell.
    - `edge`: the number of each cut edge, clipped to those that are listed.
    - `code`: the edge relative to the cell, 5 bits.
    - `held`: true in real entries. `complete`: all edges are listed, the patch is real.
    """

    node: Int[Array, " v"]
    edge: Int[Array, "k v"]
    code: Int[Array, "k v"]
    held: Bool[Array, "k v"]
    complete: Bool[Array, " v"]


def num_edges(capacity: Capacity) -> int:
    """How many cut edges, each with two faces, an extraction of this capacity lists."""
    return max(capacity.faces // 2, 1)


def count_patches(bits: Bits, numbers: Numbers) -> Counts:
    """The sizes of the dual mesh: exact for cells, at most as many of the others.

    A cell whose inside corners span V corners, E edges and F faces has V - E + F
    patches, two more where it is a ring around a body diagonal, and one more where a
    face is flipped: at most once for each of the two sides of an ambiguous face.
    Edges on the sides of the grid are counted, although they have no faces.
    """
    corners = corner_words(bits.inside)
    # A triangle per edge of a loop, less two per loop.
    cut = sum(
        jnp.sum(popcount((corners[a] ^ corners[b]) & bits.cells)) for a, b in edges()
    )
    loops = (cut - numbers.needed.faces) // 2
    flips = sum(
        jnp.sum(popcount(ambiguous([corners[c] for c in ring]) & bits.cells))
        for ring in faces()
    )
    return Counts(loops + flips, 2 * numbers.needed.vertices, numbers.needed.cells)


def find_cells(bits: Bits, numbers: Numbers, shape, capacity: Capacity, token):
    """The active cells, with the faces flipped that would not be manifold."""
    first = numbers.first_cell
    owners = expand(numbers.cells, first, capacity.cells, token)
    cases = stage(token, _cases, owners, bits)
    return stage(
        token, lambda c, i, n: _cells(*c, i, n, shape), cases, bits.inside, numbers
    )


def _cases(owners: Owners, bits: Bits):
    words = bits.cells.reshape(-1).at[owners.owner].get(mode="promise_in_bounds")
    bit = select(words, owners.place)
    return owners.owner, bit, corner_signs(bits.inside, owners.owner, bit)


def _cells(word, bit, case, inside, numbers, shape) -> PatchCells:
    tables = patch_tables()
    bridged = jnp.asarray(tables.bridged)
    real = jnp.arange(word.shape[0]) < numbers.needed.cells
    face = bridged[case]
    there = bridged[_case_across(word, bit, face, inside)]
    exists = _has_neighbor(word, bit, face, inside.shape, shape)
    flip = (face != NO_FACE) & exists & (there == face ^ 1)
    row = case + jnp.where(flip, FLIPPED, 0)
    counts = jnp.where(real, jnp.asarray(tables.counts)[row], 0)
    first = prefix_sum(counts)
    return PatchCells(word, bit, row, first, first[-1] + counts[-1])


def _case_across(word, bit, face, inside):
    """The case of the neighbor cell across a face."""
    _, ny, per_line = inside.shape
    axis, step = face >> 1, 2 * (face & 1) - 1
    moved = bit + jnp.where(axis == 2, step, 0)
    lines = jnp.where(axis == 0, ny, jnp.where(axis == 1, 1, 0))
    word = word + step * lines * per_line + (moved >> _BIT)
    return corner_signs(inside, word, moved & (WORD - 1))


def _has_neighbor(word, bit, face, words, shape):
    """True where the grid has a cell across the face."""
    _, ny, per_line = words
    line = word // per_line
    place = (line // ny, line % ny, (word % per_line) * WORD + bit)
    axis, step = face >> 1, 2 * (face & 1) - 1
    out = jnp.zeros_like(face, bool)
    for d in range(3):
        there = place[d] + step
        out = out | (axis == d) & (there >= 0) & (there <= shape[d] - 2)
    return out


def find_patches(cells: PatchCells, bits, numbers, shape, capacity, token) -> Patches:
    """The patch of every vertex of the dual, in the order of the cells."""
    ends = jnp.append(cells.first[1:], cells.num_vertices)
    owners = expand(ends - cells.first, cells.first, capacity.vertices, token)
    args = (owners, cells, numbers, bits.cut)
    return stage(token, lambda *a: _patches(*a, shape, num_edges(capacity)), *args)


def _patches(owners: Owners, cells, numbers, cut, shape, listed) -> Patches:
    read = lambda x: x.at[owners.owner].get(mode="promise_in_bounds")
    word, bit, row = read(cells.word), read(cells.bit), read(cells.row)
    tables = patch_tables()
    patch = jnp.clip(owners.place, 0, 3)
    slot = jnp.arange(tables.width)[:, None]
    entry = jnp.asarray(tables.edges)[(row * 4 + patch) * tables.width + slot]
    code, held = entry & (REAL - 1), entry >= REAL
    edge = edge_rank(word, bit, code, numbers, cut)
    real = jnp.arange(word.shape[0]) < cells.num_vertices
    complete = real & jnp.all(~held | (edge < listed), axis=0)
    nz, per_line = shape[2], cut.shape[3]
    node = (word // per_line) * nz + (word % per_line) * WORD + bit
    edge = jnp.where(held, jnp.minimum(edge, listed - 1), 0)
    return Patches(node, edge, code, held & real, complete)


def corner_indices(node: Int[Array, " k"], shape) -> Int[Array, "k 3"]:
    """The node indices of flat indices, as one array."""
    return jnp.stack(coordinates(node, shape), axis=-1)
