"""Emit the faces of bricks: as `_faces.py`, with the rows of bricks for words."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._core import prefix_sum, stage
from ._bits import Owners, expand, expand_filled, popcount, select
from ._brick_bits import SIZE, BrickBits, active_cells
from ._extraction import Capacity
from ._faces import Faces, through
from ._tables import CODE_BITS, CaseTables, tables_for


class BrickCells(eqx.Module):
    """Active cells: the row and the bit of the lower corner, the row of the tables."""

    word: Int[Array, " c"]
    bit: Int[Array, " c"]
    case: Int[Array, " c"]
    real: Bool[Array, " c"]
    first_face: Int[Array, " c"]
    num_faces: Int[Array, ""]


def emit_brick_faces(
    bits: BrickBits,
    rows: Int[Array, " r"],
    limit: Int[Array, ""],
    capacity: Capacity,
    token,
) -> Faces:
    """The faces of the cells in `rows`, neighbors in order, before the row `limit`."""
    words = bits.words.at[rows].get(mode="fill", fill_value=0)
    counts = popcount(active_cells(words))
    starts = stage(token, prefix_sum, counts)
    owners = expand(counts, starts, capacity.cells, token)
    tables = tables_for(bits.joined, bits.tunnels)
    total = starts[-1] + counts[-1]
    place = stage(token, lambda o, b: _places(o, b, rows, tables), owners, bits)
    cells = stage(token, lambda p: _cells(*p, total, limit, capacity, tables), place)
    slots = expand_filled(cells.first_face, cells.real, capacity.faces, token)
    codes = stage(token, lambda s, c: _codes(s, c, tables), slots, cells)
    corners = [
        stage(token, lambda c, b, i=i: _vertex(c, b, i), codes, bits) for i in range(3)
    ]
    real = jnp.arange(capacity.faces) < cells.num_faces
    faces = jnp.where(real[:, None], jnp.stack(corners, axis=-1), capacity.vertices)
    return Faces(faces, jnp.minimum(cells.num_faces, capacity.faces))


def _places(owners: Owners, bits, rows, tables: CaseTables):
    word = rows.at[owners.owner].get(mode="clip")
    cells = active_cells(bits.words.at[word].get(mode="clip"))
    # Slots of padding may point anywhere: any cell will do.
    bit = jnp.where(owners.place < popcount(cells), select(cells, owners.place), 0)
    case = _case(bits.inside, word, bit)
    if tables.row is not None:
        case = jnp.asarray(tables.row)[case << 6 | _joined(bits, word, bit)]
    if tables.tunnel is not None:
        words = bits.tunnels.at[word].get(mode="clip")
        case = jnp.asarray(tables.tunnel)[3 * case + through(words, words >> SIZE, bit)]
    return word, bit, case


def _case(inside, word, bit):
    """The 8 corner signs of each cell as a number, corner x + 2y + 4z."""
    n = SIZE + 1
    flat = inside.reshape(-1)
    first = (word >> 6) * n * n + (word >> 3 & 7) * n + (word & 7)
    case = jnp.zeros_like(bit)
    for corner in range(4):
        row = flat.at[first + (corner & 1) * n + (corner >> 1)].get(mode="clip")
        pair = row.astype(jnp.int32) >> bit
        case = case | (pair & 1) << corner | (pair >> 1 & 1) << (corner + 4)
    return case


def _joined(bits, word, bit):
    """The 6 faces of each cell whose inside corners are connected, as bits."""
    out = jnp.zeros_like(bit)
    for axis in range(3):
        for side in (0, 1):
            step = [side if d == axis else 0 for d in range(3)]
            row, place = bits.step(word, bit, *step)
            words = bits.joined.at[row].get(mode="fill", fill_value=0)
            one = words >> (SIZE * axis + place).astype(jnp.uint32) & 1
            out = out | one.astype(int) << (2 * axis + side)
    return out


def _cells(word, bit, case, total, limit, capacity, tables) -> BrickCells:
    real = (jnp.arange(capacity.cells) < total) & (word < limit)
    faces = jnp.where(real, jnp.asarray(tables.counts)[case], 0)
    first = prefix_sum(faces)
    return BrickCells(word, bit, case, real, first, first[-1] + faces[-1])


def _codes(slots: Owners, cells, tables):
    """For every face: the row and the bit of its cell, and its three edge codes."""
    word = cells.word.at[slots.owner].get(mode="promise_in_bounds")
    bit = cells.bit.at[slots.owner].get(mode="promise_in_bounds")
    case = cells.case.at[slots.owner].get(mode="promise_in_bounds")
    place = jnp.clip(slots.place, 0, tables.width - 1)
    return word, bit, jnp.asarray(tables.triangles)[case * tables.width + place]


def _vertex(codes, bits, i):
    word, bit, edges = codes
    code = edges >> CODE_BITS * i
    row, place = bits.step(word, bit, code >> 2 & 1, code >> 3 & 1, code >> 4 & 1)
    return bits.vertex(row, place, code & 3)
