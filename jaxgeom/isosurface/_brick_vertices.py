"""Place the vertices of bricks: as `_vertices.py`, reading across bricks."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core import safe_normalize, stage
from ..fields import NarrowBand
from ._bits import Owners, popcount, select
from ._brick_bits import SIZE, cut_edges

_NODES = SIZE + 1
_STRIDES = (_NODES * _NODES, _NODES, 1)


class BrickEdges(eqx.Module):
    """Cut edges: the brick, the lower node in it, and the axis."""

    brick: Int[Array, " v"]
    node: Int[Array, "3 v"]
    axis: Int[Array, " v"]


class BrickSamples(eqx.Module):
    """The values of a band, read along cut edges: what `Samples` is to a grid.

    `beside`: [6, b], the bricks before and after along each axis; b where none is.
    """

    band: NarrowBand
    beside: Int[Array, "6 b"]
    edges: BrickEdges

    def along(self, step: int) -> Float[Array, " v"]:
        """The values `step` nodes from the lower end; steps 0 and 1 are the ends."""
        return self._at(self.edges.brick, self._node(step))

    def beyond(self, step: int) -> tuple[Float[Array, " v"], Bool[Array, " v"]]:
        """`along(step)`, and whether the band has a finite value there (0 if not)."""
        axis = self.edges.axis
        shift = [jnp.where(axis == d, step, 0) for d in range(3)]
        return self.read(self.edges.node, shift, axis)

    def read(self, node, shift, axis):
        """The value at node + shift, and whether the band has a finite one (0 if not).

        The shift is along `axis` and may lead to the next brick.
        """
        node = jnp.stack([n + s for n, s in zip(node, shift, strict=True)])
        place = _of(axis, node)
        before, after = place < 0, place >= _NODES
        side = 2 * axis + after
        size = self.band.bricks.shape[0]
        other = self.beside.reshape(-1).at[side * size + self.edges.brick]
        other = other.get(mode="clip")
        brick = jnp.where(before | after, other, self.edges.brick)
        turn = jnp.where(before, SIZE, jnp.where(after, -SIZE, 0))
        node = jnp.stack([node[d] + jnp.where(axis == d, turn, 0) for d in range(3)])
        held = (brick < size) & self._in_grid(place, axis)
        value = self._at(jnp.where(held, brick, 0), jnp.where(held, node, 0))
        held = held & jnp.isfinite(value)
        return jnp.where(held, value, 0.0), held

    def _in_grid(self, place, axis):
        bricks = self.band.bricks.at[self.edges.brick].get(mode="clip")
        place = place + SIZE * _of(axis, bricks.T)
        return (place >= 0) & (place < _of(axis, self.band.grid.shape))

    def _node(self, step):
        edges = self.edges
        return jnp.stack(
            [n + jnp.where(edges.axis == d, step, 0) for d, n in enumerate(edges.node)]
        )

    def _at(self, brick, node):
        inside = sum(n * s for n, s in zip(node, _STRIDES, strict=True))
        flat = self.band.values.reshape(-1)
        return flat.at[brick * _NODES**3 + inside].get(mode="clip")


def bricks_beside(band: NarrowBand) -> Int[Array, "6 b"]:
    """Where the bricks before and after along each axis are stored."""
    steps = [side * np.eye(3, dtype=np.int32)[d] for d in range(3) for side in (-1, 1)]
    return jnp.stack([band.find(band.bricks + step) for step in steps])


def edges_of(owners: Owners, rows, words) -> BrickEdges:
    """The cut edge of every vertex, from its owner among `rows` and its place there."""
    row = rows.at[owners.owner].get(mode="clip")
    bits = cut_edges(words.at[row].get(mode="clip"))
    # Slots of padding may point anywhere: the first edge of a brick exists.
    place = jnp.where(owners.place < popcount(bits), select(bits, owners.place), 0)
    node = jnp.stack([row >> 3 & 7, row & 7, place & 7])
    return BrickEdges(row >> 6, node, place >> 3)


def brick_positions(
    t: Float[Array, " v"], samples: BrickSamples
) -> Float[Array, "v 3"]:
    """The points at parameter t of every edge."""
    edges, grid = samples.edges, samples.band.grid
    bricks = samples.band.bricks.at[edges.brick].get(mode="clip")
    columns = [
        (SIZE * bricks[:, d] + edges.node[d]).astype(t.dtype)
        + jnp.where(edges.axis == d, t, 0.0)
        for d in range(3)
    ]
    return grid.origin + grid.spacing * jnp.stack(columns, axis=-1)


def brick_directions(
    t: Float[Array, " v"], samples: BrickSamples, token
) -> Float[Array, "v 3"]:
    """Unit vectors of growing values: central differences at both ends of the edge,
    interpolated (one-sided where the band or the grid ends)."""
    slopes = [
        stage(token, lambda s, u, axis=axis: _slope_at(s, u, axis), samples, t)
        / samples.band.grid.spacing[axis]
        for axis in range(3)
    ]
    return stage(token, lambda s: safe_normalize(jnp.stack(s, axis=-1)), slopes)


def _slope_at(samples, t, axis):
    before, after = _slope(samples, 0, axis), _slope(samples, 1, axis)
    return before + t * (after - before)


def _slope(samples, end, axis):
    """The central difference along an axis, per spacing."""
    node, here = samples._node(end), samples.along(end)
    along = jnp.full_like(samples.edges.axis, axis)
    shift = lambda step: [step if d == axis else 0 for d in range(3)]
    forth, ahead = samples.read(node, shift(1), along)
    back, behind = samples.read(node, shift(-1), along)
    rise = jnp.where(ahead, forth, here) - jnp.where(behind, back, here)
    steps = jnp.maximum(ahead.astype(here.dtype) + behind, 1)
    return jnp.where(jnp.isfinite(rise), rise, 0.0) / steps


def _of(axis, triple):
    """The entry of a triple that belongs to each axis."""
    x, y, z = triple
    return jnp.where(axis == 0, x, jnp.where(axis == 1, y, z))
