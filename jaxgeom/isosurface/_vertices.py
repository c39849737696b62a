"""Place vertices: the k-th vertex finds its cut edge by rank, then moves along it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import safe_normalize, stage
from ..shapes import Grid
from ._bits import WORD, Owners, expand, popcount, select
from ._classify import Bits, Numbers


class CutEdges(eqx.Module):
    """Cut edges: the flat index of the lower node, and the axis."""

    node: Int[Array, " v"]
    axis: Int[Array, " v"]


class Samples(eqx.Module):
    """A field on a grid, read along cut edges."""

    values: Float[Array, "x y z"]
    edges: CutEdges

    def along(self, step: int) -> Float[Array, " v"]:
        """The values `step` nodes from the lower end; steps 0 and 1 are the ends."""
        return _at(self.values, self.edges.node + step * self.stride())

    def beyond(self, step: int) -> tuple[Float[Array, " v"], Bool[Array, " v"]]:
        """`along(step)`, and whether the grid has a finite value there (0 if not)."""
        place = _of_axis(coordinates(self.edges.node, self.values.shape), self.edges)
        size = _of_axis(self.values.shape, self.edges)
        held = (place + step >= 0) & (place + step < size)
        node = self.edges.node + jnp.where(held, step, 0) * self.stride()
        value = _at(self.values, node)
        held = held & jnp.isfinite(value)
        return jnp.where(held, value, 0.0), held

    def stride(self) -> Int[Array, " v"]:
        """The distance of the two ends in the flat values."""
        _, ny, nz = self.values.shape
        return _of_axis((ny * nz, nz, 1), self.edges)


def find_edges(bits: Bits, numbers: Numbers, nz: int, capacity: int, token):
    """The cut edge of every vertex, in the order of the numbering."""
    first = numbers.first_vertex[0]
    owners = expand(numbers.vertices, first, capacity, token)
    return stage(token, lambda o, c: _edges(o, c, nz), owners, bits.cut)


def _edges(owners: Owners, cut, nz) -> CutEdges:
    per_line = cut.shape[3]
    words = [c.at[owners.owner].get(mode="clip") for c in cut.reshape(3, -1)]
    along_x, along_y = popcount(words[0]), popcount(words[1])
    place = owners.place
    axis = (place >= along_x).astype(jnp.int32) + (place >= along_x + along_y)
    rank = place - jnp.where(axis > 0, along_x, 0) - jnp.where(axis > 1, along_y, 0)
    word = jnp.where(axis == 0, words[0], jnp.where(axis == 1, words[1], words[2]))
    line, column = owners.owner // per_line, owners.owner % per_line
    # Slots of padding may point anywhere: the first edge of the grid exists.
    real = rank < popcount(word)
    node = line * nz + column * WORD + select(word, rank)
    return CutEdges(jnp.where(real, node, 0), jnp.where(real, axis, 0))


def coordinates(node: Int[Array, " v"], shape) -> tuple[Int[Array, " v"], ...]:
    """The node indices x, y, z of flat indices."""
    _, ny, nz = shape
    line = node // nz
    return line // ny, line % ny, node % nz


def _of_axis(triple, edges):
    """The entry of a triple that belongs to the axis of each edge."""
    x, y, z = triple
    return jnp.where(edges.axis == 0, x, jnp.where(edges.axis == 1, y, z))


def _at(values, node):
    return values.reshape(-1).at[node].get(mode="promise_in_bounds")


def positions(
    t: Float[Array, " v"], edges: CutEdges, grid: Grid
) -> Float[Array, "v 3"]:
    """The points at parameter t of every edge."""
    columns = [
        c.astype(t.dtype) + jnp.where(edges.axis == d, t, 0.0)
        for d, c in enumerate(coordinates(edges.node, grid.shape))
    ]
    return grid.origin + grid.spacing * jnp.stack(columns, axis=-1)


def directions(
    t: Float[Array, " v"], samples: Samples, grid: Grid, token
) -> Float[Array, "v 3"]:
    """Unit vectors of growing values: central differences at both ends of the edge,
    interpolated (one-sided at the sides of the grid and beside non-finite values)."""
    slopes = [
        stage(token, lambda *a, axis=axis: _slope_at(*a, axis), samples, t)
        / grid.spacing[axis]
        for axis in range(3)
    ]
    return stage(token, lambda s: safe_normalize(jnp.stack(s, axis=-1)), slopes)


def _slope_at(samples, t, axis):
    low = samples.edges.node
    before = _slope(samples.values, low, axis)
    after = _slope(samples.values, low + samples.stride(), axis)
    return before + t * (after - before)


def _slope(values, node, axis):
    """The central difference along an axis, per spacing."""
    _, ny, nz = values.shape
    stride = (ny * nz, nz, 1)[axis]
    place = coordinates(node, values.shape)[axis]
    here = _at(values, node)
    forth = _at(values, jnp.where(place < values.shape[axis] - 1, node + stride, node))
    back = _at(values, jnp.where(place > 0, node - stride, node))
    ahead = (place < values.shape[axis] - 1) & jnp.isfinite(forth)
    behind = (place > 0) & jnp.isfinite(back)
    rise = jnp.where(ahead, forth, here) - jnp.where(behind, back, here)
    steps = jnp.maximum(ahead.astype(values.dtype) + behind, 1)
    return jnp.where(jnp.isfinite(rise), rise, 0.0) / steps
