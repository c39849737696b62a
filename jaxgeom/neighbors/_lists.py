"""Exact neighbors by lists of candidates, made once for points that are searched often.

Every cell of a grid lists the points nearest to its center x, c_1 to c_m. A point that
is not in the list is at least |x - c_m| from x, and so at least |x - c_m| - |q - x|
from a query q of that cell (triangle inequality). Neighbors from the list that are
nearer than this are certainly right; the other queries are searched in a tree.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._backends import AbstractBackend, AbstractIndex, in_tiles, usable
from ._kd import KdIndex, KdTree
from ._morton import bounds
from ._nearest import Nearest, inserted

# The grid reaches beyond the points by this share of their extent.
_MARGIN = 0.1
# Picking a neighbor reads the whole list: for more of them the tree is faster.
_MANY = 4
# A table of so many cells takes 68 MB with lists of 16.
_MOST_CELLS = 2**18
# Centers whose lists are made at a time.
_TILE = 2**15


class Near(eqx.Module):
    """The k nearest so far, and if that is certain."""

    items: Int[Array, "q k"]
    certain: Bool[Array, " q"]


class ListIndex(AbstractIndex):
    """Points, and the candidates of every cell of a grid about them.

    A row of `table` holds the x, the y and the z of the candidates of a cell, nearest
    to its center first, and the distance within which there is no other point.
    """

    points: Float[Array, "n 3"]
    mask: Bool[Array, " n"]
    rest: KdIndex
    low: Float[Array, " 3"]
    width: Float[Array, ""]
    counts: Int[Array, " 3"]
    table: Float[Array, "c w"]
    items: Int[Array, "c m"]

    @property
    def groups(self):
        return self.rest.groups

    @eqx.filter_jit
    def search(self, queries, active, k, reach, groups):
        if k > min(_MANY, self.items.shape[1]):
            return self.rest.search(queries, active, k, reach, groups)
        near = self.from_lists(queries, k, reach)
        doubtful = active & ~near.certain
        items = self.rest.search(queries, doubtful, k, reach, groups)
        return jnp.where(doubtful[:, None], items, near.items)

    def from_lists(self, queries, k, reach) -> Near:
        """The k nearest of the candidates."""
        n, m = self.points.shape[0], self.items.shape[1]
        cell = _cell_of(queries, self.low, self.width, self.counts)
        center = self.low + (cell + 0.5) * self.width
        row = _cell_id(cell.T, self.counts)
        # Candidates first: what is compared lies side by side for all queries.
        entry = self.table.at[row].get(mode="promise_in_bounds").T
        axis = lambda d: entry[d * m : (d + 1) * m]
        squares = sum((axis(d) - queries[:, d]) ** 2 for d in range(3))
        # Written down once: XLA would compute it again for each of the k places.
        squares = jax.lax.optimization_barrier(squares)
        rows = (k, queries.shape[0])
        best = Nearest(
            jnp.full(rows, jnp.inf, squares.dtype), jnp.zeros(rows, jnp.int32)
        )
        take = lambda j, best: inserted(best, squares[j], j)
        best = jax.lax.fori_loop(0, m, take, best)
        there = (best.squares <= reach) & (best.squares < jnp.inf)
        found = jnp.where(there, self.items[row, best.slots], n).T
        away = jnp.sqrt(jnp.sum((queries - center) ** 2, axis=1))
        limits = jnp.minimum(best.squares[-1], reach)
        size = jnp.max(jnp.abs(queries), axis=1) + jnp.max(jnp.abs(self.low))
        rounding = 32 * jnp.finfo(queries.dtype).eps * size
        certain = jnp.sqrt(limits) + away + rounding < entry[-1]
        return Near(found, certain)


class CandidateLists(AbstractBackend):
    """List the `length` nearest points of every cell of a grid, `per_point` cells for
    every point.

    Building takes more than a hundred times as long as that of a `KdTree`; searches
    of up to four neighbors near the points are about three times as fast afterwards.
    For a target that many scans are laid on. Any k is exact.
    """

    length: int = eqx.field(static=True, default=16)
    per_point: int = eqx.field(static=True, default=12)

    @eqx.filter_jit
    def build(self, points, mask):
        given, real = points, mask
        points, mask = usable(points, mask)
        n = points.shape[0]
        m, cells = min(self.length, n), min(self.per_point * n, _MOST_CELLS)
        rest = KdTree().build(points, mask)
        low, width, counts = _grid(*bounds(points, mask), cells)
        number = jnp.arange(cells, dtype=jnp.int32)
        centers = low + (_cell(number, counts) + 0.5) * width
        inside = number < jnp.prod(counts)
        anywhere = jnp.full(cells, jnp.inf, points.dtype)
        search = lambda rows: rest.search(*rows[:2], m, rows[2], None)
        items = in_tiles(search, (centers, inside, anywhere), _TILE)
        there = points.at[items].get(mode="fill", fill_value=jnp.inf)
        last = there[:, -1]
        last = jnp.sqrt(jnp.sum((last - centers) ** 2, axis=1))
        # A list with room to spare has all points.
        last = jnp.where(items[:, -1] < n, last, jnp.inf)
        table = jnp.concatenate([*(there[..., d] for d in range(3)), last[:, None]], 1)
        return ListIndex(given, real, rest, low, width, counts, table, items)


def _grid(low, high, cells):
    """The lower corner, the width and the numbers of at most `cells` cubes."""
    side = jnp.max(high - low)
    side = jnp.where(side > 0, side, 1)
    # In units of the side, whose third power need not be a number.
    extent = (high - low) / side + 2 * _MARGIN
    counts = lambda width: jnp.ceil(extent / width)
    start = jnp.cbrt(jnp.prod(extent) / cells)
    over = lambda width: jnp.prod(counts(width)) > cells
    width = jax.lax.while_loop(over, lambda width: 1.05 * width, start)
    return low - _MARGIN * side, width * side, counts(width).astype(jnp.int32)


def _cell(number, counts) -> Int[Array, "c 3"]:
    """The cell of a number, as `_cell_id` counts them."""
    column, z = jnp.divmod(number, counts[2])
    return jnp.stack([*jnp.divmod(column, counts[1]), z], axis=1)


def _cell_of(points, low, width, counts) -> Int[Array, "n 3"]:
    """The cell of every point [n, 3]; outside of the grid the nearest one."""
    scaled = jnp.floor((points - low) / width)
    return jnp.clip(scaled, 0, (counts - 1).astype(points.dtype)).astype(jnp.int32)


def _cell_id(cell, counts):
    """The number of a cell, given by its three coordinates, first axis slowest."""
    return (cell[0] * counts[1] + cell[1]) * counts[2] + cell[2]
