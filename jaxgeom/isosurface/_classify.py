"""Classify the whole grid: which edges are cut, which cells hold surface, how much."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from .._core import prefix_sum, stage
from ._ambiguity import AbstractFaceRule, ambiguous
from ._bits import WORD, pack, pack_lanes, popcount
from ._cube import edges, faces

_HALF = WORD // 2


class Counts(eqx.Module):
    """Required sizes: scalars of type int32."""

    vertices: Int[Array, ""]
    faces: Int[Array, ""]
    cells: Int[Array, ""]


class Bits(eqx.Module):
    """The inside nodes, the cut edges along each axis, and the active cells.

    `joined`: by normal axis, the ambiguous faces whose inside corners are connected;
    `tunnels`: the cells through which the inside or the outside runs between two pieces
    of surface; None where that is never so.
    """

    inside: UInt[Array, "x y w"]
    cut: UInt[Array, "3 x y w"]
    cells: UInt[Array, "x y w"]
    finite: Bool[Array, ""]
    joined: UInt[Array, "3 x y w"] | None = None
    tunnels: UInt[Array, "2 x y w"] | None = None


class Numbers(eqx.Module):
    """Per word: the number of its first vertex (per axis) and of its first cell."""

    first_vertex: Int[Array, "3 m"]
    vertices: Int[Array, " m"]
    first_cell: Int[Array, " m"]
    cells: Int[Array, " m"]
    needed: Counts


def classify(
    values: Float[Array, "x y z"],
    level: Float[Array, ""],
    rule: AbstractFaceRule,
    token: Bool[Array, ""] | None,
) -> tuple[Bits, Numbers]:
    """The bits of the grid and the numbering that follows from them."""
    nz = values.shape[2]
    halves = stage(token, _halves, values, level)
    inside, finite = stage(token, _join_halves, halves)
    bits = stage(token, lambda i, f: _bits(i, f, nz), inside, finite)
    corners = stage(token, corner_words, bits.inside)
    num_faces = stage(token, count_faces, corners, bits.cells)
    decided = rule(values, level, token)
    joined, tunnels = decided.joined, decided.tunnels
    if joined is not None:
        joined = stage(token, _on_ambiguous, joined, corners, bits.inside)
        # A join leaves at most one loop fewer, two triangles more, in either cell.
        num_faces = num_faces + 4 * jnp.sum(popcount(joined))
    if tunnels is not None:
        tunnels = tunnels & bits.cells
        # A tube between two loops has four triangles more than two discs.
        num_faces = num_faces + 4 * jnp.sum(popcount(tunnels))
    bits = Bits(bits.inside, bits.cut, bits.cells, bits.finite, joined, tunnels)
    return bits, stage(token, _number, bits, num_faces)


def _on_ambiguous(decided, corners, inside):
    """The decided faces that are ambiguous, and exist."""
    out = []
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        ring = [corners[c] for c in (0, u, u + v, v)]
        out.append(decided[axis] & ambiguous(ring))
    return jnp.stack(out)


def _halves(values, level):
    """16 nodes a word: inside in the lower half, not finite in the upper one.

    Both in one word, so that the dense values are read once.
    """
    finite = jnp.isfinite(values)
    inside = (values < level) & finite
    lanes = inside.astype(jnp.uint32) | (~finite).astype(jnp.uint32) << _HALF
    return pack_lanes(lanes, _HALF)


def _join_halves(halves):
    n = halves.shape[2]
    padded = jnp.pad(halves, ((0, 0), (0, 0), (0, n % 2)))
    low, high = padded[:, :, 0::2], padded[:, :, 1::2]
    mask = jnp.uint32((1 << _HALF) - 1)
    inside = (low & mask) | (high & mask) << _HALF
    return inside, ~jnp.any(halves >> _HALF)


def _bits(inside, finite, nz) -> Bits:
    not_last = pack(jnp.arange(inside.shape[2] * WORD) < nz - 1)
    next_z = _next_z(inside)
    cut_z = (inside ^ next_z) & not_last
    cut = jnp.stack([inside ^ _next(inside, 0), inside ^ _next(inside, 1), cut_z])
    some, every = inside | next_z, inside & next_z
    for axis in (0, 1):
        some, every = some | _next(some, axis), every & _next(every, axis)
    return Bits(inside, cut, some & ~every & _cell_mask(inside.shape, nz), finite)


def _cell_mask(shape, nz):
    """The nodes that are the lower corner of a cell."""
    x, y = (jnp.arange(n) < n - 1 for n in shape[:2])
    z = pack(jnp.arange(shape[2] * WORD) < nz - 1)
    return jnp.where(x[:, None, None] & y[:, None], z, jnp.uint32(0))


def _next(words, axis):
    """The words of the next node along an axis; the last repeats itself."""
    n = words.shape[axis]
    return jnp.take(words, np.minimum(np.arange(n) + 1, n - 1), axis=axis)


def _next_z(words):
    n = words.shape[2]
    following = jnp.take(words, np.minimum(np.arange(n) + 1, n - 1), axis=2)
    return (words >> 1) | (following << (WORD - 1))


def _number(bits: Bits, num_faces) -> Numbers:
    """Number vertices and cells in the order of the words, x before y before z."""
    per_axis = popcount(bits.cut).reshape(3, -1)
    vertices = jnp.sum(per_axis, axis=0)
    start = prefix_sum(vertices)
    first_vertex = start + jnp.cumsum(per_axis, axis=0) - per_axis
    cells = popcount(bits.cells).reshape(-1)
    needed = Counts(jnp.sum(vertices), num_faces, jnp.sum(cells))
    return Numbers(first_vertex, vertices, prefix_sum(cells), cells, needed)


def count_faces(corners, active):
    """The number of triangles of all cells, 32 cells at a time.

    A loop of k edges has k - 2 triangles. A cell whose inside corners span V corners,
    E edges and F faces has V - E + F loops, and two more where its outside corners are
    the ends of a body diagonal: then the inside is a ring, with a loop at either end.
    """
    every = lambda group: _all([corners[c] for c in group])
    total = lambda words: popcount(words & active)
    cut = sum(total(corners[a] ^ corners[b]) for a, b in edges())
    euler = sum(total(c) for c in corners)
    euler -= sum(total(every(e)) for e in edges())
    euler += sum(total(every(ring)) for ring in faces())
    rings = sum(total(_ring_around(corners, c)) for c in range(4))
    return jnp.sum(cut - 2 * euler - 4 * rings)


def corner_words(inside):
    """The inside bits of the 8 corners of the cells, corner x + 2y + 4z."""
    along_x = [inside, _next(inside, 0)]
    along_xy = [*along_x, *(_next(w, 1) for w in along_x)]
    return [*along_xy, *(_next_z(w) for w in along_xy)]


def _ring_around(corners, outside):
    """The cells in which the ends of one body diagonal alone are outside."""
    ends = (outside, 7 - outside)
    others = _all([corners[c] for c in range(8) if c not in ends])
    return others & ~corners[ends[0]] & ~corners[ends[1]]


def _all(words):
    out = words[0]
    for word in words[1:]:
        out = out & word
    return out
