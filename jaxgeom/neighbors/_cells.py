"""Exact neighbors by a cell list, with a certificate and a fallback.

Points are sorted by cell. A query looks at the cells around it (2 x 2 x 2 for single
neighbors, 3 x 3 x 3 smaller ones for many): runs of cells along z, read as one list.
What it finds is certainly right where the k-th distance is at most the distance to the
boundary of these cells. The other queries (few, if the cell size suits the density)
look at a cube two cells wider, and what is left is searched in a tree.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import prefix_sum
from ._backends import AbstractBackend, AbstractIndex, usable
from ._morton import LEVELS, bounds, curve, morton_order, occupied_cells
from ._tree import Nearest, Tree, grow, insert, search_tree

_LEAF = 8
_LANES = 256
# Queries of a tile of the second look.
_FEW = 256
# From so many neighbors on it pays to sort queries by the length of their lists.
_MANY = 4
# Queries of a tile of the first look: their lists should stay in the cache.
_TILE = 1024
_SMALLEST_TABLE, _LARGEST_TABLE = 2**12, 2**24
_CELLS_PER_POINT = 16
_NEVER = 2**30


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
    span: int = eqx.field(static=True)

    # Outside jit, control flow compiles what it closes over as constants, anew at
    # every call, and XLA spends most of a minute folding them.
    @eqx.filter_jit
    def search(self, queries, active, k, reach):
        near = _search_near(self, queries, active, k, reach)
        for again in (_search_wider, search_in_tree):
            wanted = active & ~near.certain
            near = jax.lax.cond(
                jnp.any(wanted),
                lambda near, wanted, again=again: again(
                    self, queries, wanted, near, k, reach
                ),
                lambda near, wanted: near,
                *(near, wanted),
            )
        return near.items


class Near(eqx.Module):
    """The k nearest so far, how far to search yet (squared), and if that is certain."""

    items: Int[Array, "q k"]
    limits: Float[Array, " q"]
    certain: Bool[Array, " q"]


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
        many = self.neighbors >= _MANY
        per_cell = max(4, 3 * self.neighbors // 5) if many else 4
        width = _density_width(coarse, fine, mask[order], high - low, per_cell)
        table = _table_size(points.shape[0])
        width = _fitting_width(width, high - low, table)
        counts = _cell_counts(high - low, width)
        cell = cell_id(cell_of(points, low, width, counts).T, counts)
        cell = jnp.where(mask, cell, table)
        cell, order = jax.lax.sort(
            (cell, jnp.arange(points.shape[0], dtype=jnp.int32)), num_keys=1
        )
        starts = prefix_sum(jnp.zeros(table + 1, jnp.int32).at[cell].add(1))
        soa = tuple(points[:, d][order] for d in range(3))
        return CellIndex(
            *(given, real, low, high, width, counts, starts, order, soa, tree),
            longest=16 * per_cell,
            span=3 if many else 2,
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


def cell_of(points, low, width, counts) -> Int[Array, "n 3"]:
    """The cell of every point [n, 3]; outside of the grid the nearest one."""
    scaled = jnp.floor((points - low) / width)
    return jnp.clip(scaled, 0, (counts - 1).astype(points.dtype)).astype(jnp.int32)


def cell_id(cell, counts):
    """The number of a cell, given by its three coordinates, first axis slowest."""
    return (cell[0] * counts[1] + cell[1]) * counts[2] + cell[2]


def _search_near(index, queries, active, k, reach) -> Near:
    """Every active query in the cells around it, lists of similar length together."""
    q = queries.shape[0]
    rows, count = _listed(active)
    if k >= _MANY and q > _TILE:
        length = jnp.where(active, _block(index, queries, index.span).total, _NEVER)
        _, rows = jax.lax.sort((length, jnp.arange(q, dtype=jnp.int32)), num_keys=1)
    blank = Near(
        jnp.full((q, k), index.points.shape[0], jnp.int32),
        jnp.full(q, reach, queries.dtype),
        ~active,
    )
    queue = (rows, count)
    return _search_tiles(index, queries, queue, blank, k, reach, index.span, _TILE)


class _Block(eqx.Module):
    """The cells around each query: `first` and `final` of them, the runs they fill as
    one list (where each run ends, from list index to position), and its length."""

    first: Int[Array, "t 3"]
    final: Int[Array, "t 3"]
    ends: Int[Array, "r t"]
    shifts: Int[Array, "r t"]
    total: Int[Array, " t"]

    def position(self, j):
        """The place in cell order of number j of the list."""
        run = sum((j >= end).astype(jnp.int32) for end in self.ends[:-1])
        return j + self.shifts[run, jnp.arange(self.total.shape[0])]


def _block(index, queries, span) -> _Block:
    """The cube of `span`^3 cells around each query."""
    starts = index.starts
    last = (index.counts - 1).astype(queries.dtype)
    scaled = (queries - index.low) / index.width
    safe = jnp.where(jnp.isfinite(scaled), scaled, 0)
    corner = jnp.floor(safe - (span - 1) / 2)
    first = jnp.clip(corner, 0, jnp.maximum(last - (span - 1), 0)).astype(jnp.int32)
    final = jnp.minimum(first + (span - 1), index.counts - 1)
    # The runs along z of the columns of cells, one row each.
    x, y = jnp.divmod(jnp.arange(span**2, dtype=jnp.int32)[:, None], span)
    cell = first[:, 0] + x, first[:, 1] + y
    there = (cell[0] <= final[:, 0]) & (cell[1] <= final[:, 1])
    row = jnp.where(there, cell_id((*cell, 0), index.counts), 0)
    begin = starts[row + first[:, 2]]
    length = jnp.where(there, starts[row + final[:, 2] + 1] - begin, 0)
    ends = jnp.cumsum(length, axis=0, dtype=jnp.int32)
    return _Block(first, final, ends, begin + length - ends, ends[-1])


def _search_cells(index, queries, active, k, reach, span) -> Near:
    """The k nearest in the cube of `span`^3 cells around each query."""
    n = index.points.shape[0]
    block = _block(index, queries, span)
    longest = index.longest * span**2 // 4
    length = jnp.where(active, jnp.minimum(block.total, longest), 0)
    near = _nearest_in_list(index, queries, block, length, longest, k)
    squares = near.squares
    there = (squares <= reach) & (squares < jnp.inf)
    positions = jnp.where(there, block.position(near.items), n)
    found = index.order.at[positions].get(mode="fill", fill_value=n)
    room = _room(index, queries, block.first, block.final)
    least = jnp.minimum(squares[-1], reach)
    return Near(found.T, least, (block.total <= longest) & (least <= room))


def _nearest_in_list(index, queries, block, length, longest, k) -> Nearest:
    """The k smallest squared distances [k, t] of each list, and their list indices.

    Distances are written down before they are compared: XLA would compute a gather
    again for each of the k places it is compared with.
    """
    steps = jnp.max(length)

    def measure(j, table):
        position = block.position(j)
        square = sum(
            (queries[:, d] - index.coordinates[d].at[position].get(mode="clip")) ** 2
            for d in range(3)
        )
        return table.at[j].set(jnp.where(j < length, square, jnp.inf))

    blank = jnp.full((longest, queries.shape[0]), jnp.inf, queries.dtype)
    table = jax.lax.fori_loop(0, steps, measure, blank)
    rows = (k, queries.shape[0])
    empty = Nearest(jnp.full(rows, jnp.inf, queries.dtype), jnp.zeros(rows, jnp.int32))
    take = lambda j, best: insert(best, table[j], j)
    return jax.lax.fori_loop(0, steps, take, empty)


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


def _search_wider(index, queries, wanted, near, k, reach) -> Near:
    """`near`, with the wanted rows searched in more cells."""
    queue, span = _listed(wanted), index.span + 2
    return _search_tiles(index, queries, queue, near, k, reach, span, _FEW)


def _search_tiles(index, queries, queue, near, k, reach, span, size) -> Near:
    """`near`, with the first `count` of the rows searched, a tile of them at a time."""
    rows, count = queue
    q = queries.shape[0]
    size = min(size, q)
    rows = jnp.pad(rows, (0, -q % size), constant_values=q)
    number = jnp.arange(size, dtype=jnp.int32)

    def tile(i, near):
        row = jax.lax.dynamic_slice(rows, (i * size,), (size,))
        row = jnp.where(i * size + number < count, row, q)
        points = queries.at[row].get(mode="fill", fill_value=0)
        found = _search_cells(index, points, row < q, k, reach, span)
        put = lambda to, x: to.at[row].set(x, mode="drop")
        return jax.tree.map(put, near, found)

    return jax.lax.fori_loop(0, -(-count // size), tile, near)


def _listed(wanted):
    """The rows that are wanted, the rest q, and how many they are."""
    q = wanted.shape[0]
    place = jnp.where(wanted, prefix_sum(wanted.astype(jnp.int32)), q)
    number = jnp.arange(q, dtype=jnp.int32)
    rows = jnp.full(q, q, jnp.int32).at[place].set(number, mode="drop")
    return rows, jnp.sum(wanted, dtype=jnp.int32)


def search_in_tree(index, queries, wanted, near, k, reach) -> Near:
    """`near`, with the wanted rows searched in the tree."""
    # The same distance may be rounded differently here and in the cells.
    limits = near.limits * (1 + 8 * jnp.finfo(near.limits.dtype).eps)
    tree = index.tree
    clean, _ = usable(index.points, index.mask)
    soa = clean.T.at[:, tree.order].get(mode="fill", fill_value=jnp.inf)

    def squares(slots, points):
        return sum((points[d] - soa[d][slots]) ** 2 for d in range(3))

    rows, count = _listed(wanted)
    # Along a curve lanes stay together, but a few queries are not worth a sort.
    rows = jax.lax.cond(count > _LANES, lambda: curve(queries, wanted), lambda: rows)
    queue = (rows, count)
    found = search_tree(tree, queries, limits, queue, squares, k=k, lanes=_LANES)
    n = index.points.shape[0]
    items = jnp.where(found.squares <= reach, jnp.minimum(found.items, n), n).T
    items = jnp.where(wanted[:, None], items, near.items)
    return Near(items, near.limits, near.certain | wanted)
