"""Emit faces: a face names its vertices by the rank of its three cut edges."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._core import prefix_sum, stage
from ._bits import WORD, Owners, below, expand, expand_filled, popcount, select
from ._classify import Bits, Numbers
from ._extraction import Capacity
from ._tables import CODE_BITS, CaseTables, tables_for

_BIT = WORD.bit_length() - 1


class Cells(eqx.Module):
    """Active cells: the word and the bit of the lower corner, the row of the tables.

    Bit and row share an integer, since the faces read both at once.
    """

    word: Int[Array, " c"]
    bit_and_row: Int[Array, " c"]
    real: Bool[Array, " c"]
    first_face: Int[Array, " c"]
    num_faces: Int[Array, ""]


class Faces(eqx.Module):
    """Faces of static capacity, padded with the vertex capacity, and their number."""

    corners: Int[Array, "f 3"]
    num_faces: Int[Array, ""]


def emit_faces(bits: Bits, numbers: Numbers, capacity: Capacity, token) -> Faces:
    """The faces of the active cells, in the order of the cells."""
    first, size = numbers.first_cell, capacity.cells
    owners = expand(numbers.cells, first, size, token)
    tables = tables_for(bits.joined, bits.tunnels)
    place = stage(token, lambda o, b: _places(o, b, tables), owners, bits)
    cells = stage(
        token, lambda p, n: _cells(*p, n, bits, capacity, tables), place, numbers
    )
    slots = expand_filled(cells.first_face, cells.real, capacity.faces, token)
    codes = stage(token, lambda s, c: _codes(s, c, tables), slots, cells)
    corners = [
        stage(token, lambda *a, i=i: _vertex_number(*a, i), codes, numbers, bits.cut)
        for i in range(3)
    ]
    faces = stage(token, lambda *a: _pack(*a, capacity), corners, cells.num_faces)
    return Faces(faces, jnp.minimum(cells.num_faces, capacity.faces))


def _places(owners: Owners, bits, tables: CaseTables):
    words = bits.cells.reshape(-1).at[owners.owner].get(mode="promise_in_bounds")
    bit = select(words, owners.place)
    row = corner_signs(bits.inside, owners.owner, bit)
    if tables.row is not None:
        row = jnp.asarray(tables.row)[
            row << 6 | _joined(bits.joined, owners.owner, bit)
        ]
    if tables.tunnel is not None:
        flat = bits.tunnels.reshape(2, -1)
        inside, outside = (w.at[owners.owner].get(mode="clip") for w in flat)
        row = jnp.asarray(tables.tunnel)[3 * row + through(inside, outside, bit)]
    return owners.owner, bit | row << _BIT


def through(inside, outside, bit):
    """Which side runs through: 0 for neither, 1 for the inside, 2 for the outside."""
    one = lambda words: (words >> bit.astype(jnp.uint32) & 1).astype(int)
    return one(inside) | one(outside) << 1


def _joined(joined, word, bit):
    """The 6 faces of each cell whose inside corners are connected, as bits."""
    _, _, ny, per_line = joined.shape
    out = jnp.zeros_like(bit)
    for axis in range(3):
        flat = joined[axis].reshape(-1)
        for side in (0, 1):
            step = side * (ny * per_line, per_line, 0)[axis]
            place = bit + (side if axis == 2 else 0)
            words = flat.at[word + step + (place >> _BIT)].get(mode="clip")
            one = words >> (place & (WORD - 1)).astype(jnp.uint32) & 1
            out = out | one.astype(int) << (2 * axis + side)
    return out


def corner_signs(inside, word, bit):
    """The 8 corner signs of each cell as a number, corner x + 2y + 4z."""
    _, ny, per_line = inside.shape
    flat = inside.reshape(-1)
    shift = bit.astype(jnp.uint32)
    crosses = shift == WORD - 1
    case = jnp.zeros_like(bit)
    for corner in range(4):
        here = word + ((corner & 1) * ny + (corner >> 1)) * per_line
        low = flat.at[here].get(mode="clip") >> shift
        following = flat.at[here + crosses].get(mode="clip")
        high = jnp.where(crosses, following, low >> 1)
        case = case | ((low & 1) << corner | (high & 1) << (corner + 4)).astype(int)
    return case


def _cells(word, bit_and_row, numbers, bits, capacity, tables) -> Cells:
    real = jnp.arange(capacity.cells) < numbers.needed.cells
    real = real & (word < _word_limit(numbers, bits, capacity))
    faces = jnp.where(real, jnp.asarray(tables.counts)[bit_and_row >> _BIT], 0)
    first = prefix_sum(faces)
    return Cells(word, bit_and_row, real, first, first[-1] + faces[-1])


def _word_limit(numbers, bits, capacity):
    """The word before which all vertices of all cells fit the capacity.

    Vertices and cells have the same order, so that on overflow the faces that name
    existing vertices only are a prefix.
    """
    _, ny, per_line = bits.inside.shape
    num_words = numbers.vertices.shape[0]
    ends = numbers.first_vertex[0] + numbers.vertices
    fitting = jnp.sum(ends <= capacity.vertices)
    reach = (ny + 1) * per_line + 1
    return jnp.where(fitting == num_words, num_words, fitting - reach)


class _Codes(eqx.Module):
    """For every face: the word and the bit of its cell, and its three edge codes."""

    word: Int[Array, " f"]
    bit: Int[Array, " f"]
    edges: Int[Array, " f"]


def _codes(slots: Owners, cells, tables) -> _Codes:
    word = cells.word.at[slots.owner].get(mode="promise_in_bounds")
    both = cells.bit_and_row.at[slots.owner].get(mode="promise_in_bounds")
    place = jnp.clip(slots.place, 0, tables.width - 1)
    edges = jnp.asarray(tables.triangles)[(both >> _BIT) * tables.width + place]
    return _Codes(word, both & (WORD - 1), edges)


def _vertex_number(codes, numbers, cut, i):
    """The vertex on the edge number i of every face."""
    return edge_rank(codes.word, codes.bit, codes.edges >> CODE_BITS * i, numbers, cut)


def edge_rank(word, bit, code, numbers: Numbers, cut) -> Int[Array, " k"]:
    """The number of a cut edge of a cell, the code of 5 bits relative to its corner.

    First vertex of the word and axis + number of cut edges at lower bits.
    """
    axis, dx, dy, dz = code & 3, code >> 2 & 1, code >> 3 & 1, code >> 4 & 1
    _, _, ny, per_line = cut.shape
    bit = bit + dz
    word = word + (dx * ny + dy) * per_line + (bit >> _BIT)
    index = axis * numbers.first_vertex.shape[1] + word
    first = numbers.first_vertex.reshape(-1).at[index].get(mode="clip")
    edges = cut.reshape(-1).at[index].get(mode="clip")
    return first + popcount(edges & below(bit & (WORD - 1)))


def _pack(corners, num_faces, capacity):
    real = jnp.arange(capacity.faces) < num_faces
    return jnp.where(real[:, None], jnp.stack(corners, axis=-1), capacity.vertices)
