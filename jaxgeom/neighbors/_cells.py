"""Exact neighbors by a cell list, with a certificate and a fallback.

Points are sorted by cell. A query looks at the 2 x 2 x 2 cells around it: four runs of
two cells, read as one list. What it finds is certainly right where the k-th distance is
at most the distance to the boundary of these cells; the other queries (few, if the cell
size suits the density) are searched again in a tree.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import prefix_sum
from ._backends import AbstractBackend, AbstractIndex, in_tiles, usable
from ._morton import LEVELS, bounds, curve, morton_order, occupied_cells
from ._tree import Tree, grow, insert, search_tree

_LEAF = 8
_LANES = 1024
# Lists of k candidates per query of a tile should stay in the cache.
_TILE_ENTRIES = 4096
_SMALLEST_TABLE, _LARGEST_TABLE = 2**12, 2**24
_CELLS_PER_POINT = 16


class CellIndex(AbstractIndex):
    """Points sorted into cells of one size, and into a tree."""

    points: Float[Array, "n 3"]
    mask: Bool[Array, " n"]
    low: Float[Array, " 3"]
    high: Float[Array, " 3"]
    width: Float[Array, ""]
    counts: Int[Array, " 3"]
    starts: Int[Array, " c"]
    order: Int[Array, " n"]
    coordinates: tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]
    tree: Tree
    longest: int = eqx.field(static=True)

    # Outside jit, control flow compiles what it closes over as constants, anew at
    # every call, and XLA spends most of a minute folding them.
    @eqx.filter_jit
    def search(self, queries, active, k, reach):
        size = max(256, _TILE_ENTRIES // k)
        found, squares, certain = in_tiles(
            lambda rows: _search_cells(self, *rows, k, reach), (queries, active), size
        )
        wanted = active & ~certain
        return jax.lax.cond(
            jnp.any(wanted),
            lambda: _search_again(self, queries, wanted, found, squares, k, reach),
            lambda: found,
        )


class CellList(AbstractBackend):
    """Sort points into cells sized for searches of about `neighbors` neighbors.

    Any k is exact; searches of many more neighbors than `neighbors` are slower.
    """

    neighbors: int = eqx.field(static=True, default=1)

    @eqx.filter_jit
    def build(self, points, mask):
        given, real = points, mask
        points, mask = usable(points, mask)
        low, high = bounds(points, mask)
        order, coarse, fine = morton_order(points, mask, low, high)
        tree = grow(order, mask, points, points, _LEAF)
        per_cell = max(4, 4 * self.neighbors // 3)
        width = _density_width(coarse, fine, mask[order], high - low, per_cell)
        table = _table_size(points.shape[0])
        width = _fitting_width(width, high - low, table)
        counts = _cell_counts(high - low, width)
        cell = _cell_id(_cell_of(points, low, width, counts).T, counts)
        cell = jnp.where(mask, cell, table)
        cell, order = jax.lax.sort(
            (cell, jnp.arange(points.shape[0], dtype=jnp.int32)), num_keys=1
        )
        starts = prefix_sum(jnp.zeros(table + 1, jnp.int32).at[cell].add(1))
        soa = tuple(points[:, d][order] for d in range(3))
        return CellIndex(
            *(given, real, low, high, width, counts, starts, order, soa, tree),
            longest=16 * per_cell,
        )


def _table_size(n):
    size = 1 << (max(n, 1) * _CELLS_PER_POINT - 1).bit_length()
    return min(max(size, _SMALLEST_TABLE), _LARGEST_TABLE)


def _density_width(coarse, fine, mask, extent, per_cell):
    """The cell width at which occupied cells hold `per_cell` points on average."""
    occupied = occupied_cells(coarse, fine, mask).astype(extent.dtype)
    load = jnp.sum(mask).astype(extent.dtype) / jnp.maximum(occupied, 1)
    # Loads fall with the level: interpolate the level at which they cross per_cell.
    level = jnp.interp(
        -jnp.log(jnp.asarray(per_cell, extent.dtype)),
        -jnp.log(jnp.maximum(load, 1)),
        jnp.arange(LEVELS + 1, dtype=extent.dtype),
    )
    side = jnp.max(extent)
    return jnp.where(side > 0, side, 1) * 2.0**-level


def _fitting_width(width, extent, table):
    """`width`, raised until the cells of the bounding box fit the table."""
    cells = lambda w: jnp.prod(jnp.floor(extent / w) + 1)
    return jax.lax.while_loop(lambda w: cells(w) > table, lambda w: 1.125 * w, width)


def _cell_counts(extent, width):
    return (jnp.floor(extent / width) + 1).astype(jnp.int32)


def _cell_of(points, low, width, counts):
    scaled = jnp.floor((points - low) / width)
    return jnp.clip(scaled, 0, (counts - 1).astype(points.dtype)).astype(jnp.int32)


def _cell_id(cell, counts):
    return (cell[0] * counts[1] + cell[1]) * counts[2] + cell[2]


def _search_cells(index, queries, active, k, reach):
    """The k nearest in the 2 x 2 x 2 cells around, how far the search has to reach if
    that is not certain, and whether it is."""
    n, starts = index.points.shape[0], index.starts
    last = (index.counts - 1).astype(queries.dtype)
    scaled = (queries - index.low) / index.width
    safe = jnp.where(jnp.isfinite(scaled), scaled, 0)
    first = jnp.clip(jnp.floor(safe - 0.5), 0, jnp.maximum(last - 1, 0)).astype(
        jnp.int32
    )
    final = jnp.minimum(first + 1, index.counts - 1)
    runs = []
    for x in (first[:, 0], final[:, 0]):
        for y in (first[:, 1], final[:, 1]):
            row = _cell_id((x, y, 0), index.counts)
            runs.append((starts[row + first[:, 2]], starts[row + final[:, 2] + 1]))
    runs = _without_repeats(runs, index.counts)
    ends, shifts, total = _chain(runs)
    length = jnp.where(active, jnp.minimum(total, index.longest), 0)
    steps = jnp.max(length)

    def step(j, best):
        position = j + shifts[0]
        for end, shift in zip(ends[:-1], shifts[1:], strict=True):
            position = jnp.where(j >= end, j + shift, position)
        position = jnp.where(j < length, position, n)
        square = sum(
            (queries[:, d] - index.coordinates[d].at[position].get(mode="clip")) ** 2
            for d in range(3)
        )
        return insert(best, jnp.where(j < length, square, jnp.inf), position)

    empty = jnp.full((k, queries.shape[0]), jnp.inf, queries.dtype)
    best = (empty, jnp.full(empty.shape, n, jnp.int32))
    squares, positions = jax.lax.fori_loop(0, steps, step, best)
    positions = jnp.where(squares <= reach, positions, n)
    found = index.order.at[positions].get(mode="fill", fill_value=n)
    room = _room(index, queries, first, final)
    least = jnp.minimum(squares[-1], reach)
    return found.T, least, (total <= index.longest) & (least <= room)


def _without_repeats(runs, counts):
    """With a single layer of cells along x or y, two runs are the same: drop one."""
    one_x, one_y = counts[0] == 1, counts[1] == 1
    repeated = (jnp.asarray(False), one_y, one_x, one_x | one_y)
    return [
        (start, jnp.where(again, start, stop))
        for (start, stop), again in zip(runs, repeated, strict=True)
    ]


def _chain(runs):
    """The runs as one list: where each ends, and from list index to position."""
    ends, shifts, total = [], [], 0
    for start, stop in runs:
        shifts.append(start - total)
        total = total + stop - start
        ends.append(total)
    return ends, shifts, total


def _room(index, queries, first, final):
    """The squared distance to the nearest cell that was not looked at."""
    low, high, width = index.low, index.high, index.width
    below = queries - (low + width * first)
    above = (low + width * (final + 1)) - queries
    below = jnp.where(first == 0, jnp.inf, below)
    above = jnp.where(final == index.counts - 1, jnp.inf, above)
    # Cell boundaries are rounded: give away a few units of the last place.
    size = jnp.maximum(jnp.max(jnp.abs(queries), -1), jnp.max(jnp.abs(low)))
    size = jnp.maximum(size, jnp.max(jnp.abs(high)))
    room = jnp.min(jnp.minimum(below, above), axis=-1)
    room = room - 16 * jnp.finfo(queries.dtype).eps * size
    return jnp.maximum(room, 0) ** 2


def _search_again(index, queries, wanted, found, limits, k, reach):
    """`found`, with the wanted rows searched again, up to the squares `limits`."""
    # The same distance may be rounded differently here and in the cells.
    limits = limits * (1 + 8 * jnp.finfo(limits.dtype).eps)
    tree = index.tree
    clean, _ = usable(index.points, index.mask)
    soa = clean.T.at[:, tree.order].get(mode="fill", fill_value=jnp.inf)

    def squares(slots, points):
        return sum((points[d] - soa[d][slots]) ** 2 for d in range(3))

    queue = (curve(queries, wanted), jnp.sum(wanted))
    near = search_tree(tree, queries, limits, queue, squares, k=k, lanes=_LANES)
    n = index.points.shape[0]
    items = jnp.where(near.squares <= reach, jnp.minimum(near.items, n), n).T
    return jnp.where(wanted[:, None], items, found)
