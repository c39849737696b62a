"""Bricks of 8^3 cells: their order, and which of them may hold surface.

Bricks are found from coarse to fine: a box is dropped where the field, at its center,
is larger than the Lipschitz constant times half the diagonal. The eight children of a
box follow it in place, so that the bricks lie along a Morton curve, without sorting.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core import GeometryError, message, prefix_sum, safe_norm
from ..shapes import Grid

BRICK = 8
NODES = BRICK + 1
_MOST = 1024  # bricks along an axis: their number in Morton order has 30 bits
_OFFSETS = np.stack(np.meshgrid(*[(0, 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
_ROUNDINGS = 64


def morton(bricks: Int[Array, "*b 3"]) -> Int[Array, "*b"]:
    """The place of bricks along the Morton curve: their bits, interleaved."""
    x, y, z = (_spread(bricks[..., d]) for d in range(3))
    return x << 2 | y << 1 | z


def _spread(x):
    """The ten bits of a number, two zeros between neighbors."""
    for shift, mask in ((16, 0x30000FF), (8, 0x300F00F), (4, 0x30C30C3)):
        x = (x | x << shift) & mask
    return (x | x << 2) & 0x9249249


class Sampler(eqx.Module):
    """A field less its level at the nodes of a grid, and a bound of its slope.

    With `closed`, the outer layer of the grid mirrors the one before it about the
    level, to the outside.
    """

    field: Callable
    grid: Grid
    level: Float[Array, ""]
    lipschitz: Float[Array, ""]
    width: Float[Array, ""]
    closed: bool = eqx.field(static=True)

    def at_node(self, node: Int[Array, " 3"]) -> Float[Array, ""]:
        """The value at one node."""
        if not self.closed:
            return self._at(node)
        inner = jnp.clip(node, 1, np.array(self.grid.shape) - 2)
        found = self._at(inner)
        outside = jnp.where(jnp.isfinite(found), jnp.abs(found), 1)
        return jnp.where(jnp.any(inner != node), outside, found)

    def brick(self, brick: Int[Array, " 3"]) -> Float[Array, "n n n"]:
        """The values at the 9^3 nodes of one brick."""
        n = jnp.arange(NODES, dtype=jnp.int32)
        nodes = jnp.stack(jnp.meshgrid(n, n, n, indexing="ij"), axis=-1)
        values = jax.vmap(self.at_node)((nodes + BRICK * brick).reshape(-1, 3))
        return values.reshape(NODES, NODES, NODES)

    def undecided(self, box: Int[Array, " 3"], size) -> Bool[Array, ""]:
        """Whether points within `width` of the surface may lie in a box."""
        dtype = self.grid.origin.dtype
        index = size * (box.astype(dtype) + 0.5)
        center = self.grid.origin + self.grid.spacing * index
        reach = safe_norm(self.grid.spacing) * size / 2
        value = self.field(center) - self.level
        # What rounding does to the center and to the value.
        slack = _ROUNDINGS * jnp.finfo(dtype).eps
        reach = reach + self.width + slack * (reach + jnp.max(jnp.abs(center)))
        bound = self.lipschitz * reach + slack * jnp.abs(value)
        # A value that is not a number decides nothing.
        keep = ~(jnp.abs(value) > bound)
        if self.closed:
            last = np.array(self.grid.shape) - 1
            side = jnp.any((box == 0) | (size * (box + 1) >= last))
            keep = keep | (side & ~(value > bound))
        return keep

    def _at(self, node):
        place = node.astype(self.grid.origin.dtype)
        return self.field(self.grid.origin + self.grid.spacing * place) - self.level


def check_size(grid: Grid) -> None:
    """Raise `GeometryError` for a grid with too many bricks along an axis."""
    if max(grid.shape) > BRICK * _MOST:
        raise GeometryError(
            message(
                f"a narrow band may have at most {BRICK * _MOST} nodes along an axis",
                f"shape {grid.shape}",
                "Take a lower resolution, or several grids side by side.",
            )
        )


def all_boxes(grid: Grid, size: int) -> Int[np.ndarray, "b 3"]:
    """All boxes of `size` cells, along the Morton curve."""
    counts = [-(-n // size) for n in grid.shape]
    boxes = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
    boxes = boxes.reshape(-1, 3).astype(np.int32)
    return boxes[np.argsort(morton(boxes))]


def coarsest(grid: Grid, most: int) -> int:
    """The smallest size of boxes of which at most `most` fill the grid."""
    size = BRICK
    while np.prod([-(-n // size) for n in grid.shape]) > most:
        size *= 2
    return size


def children(boxes):
    """The 8 boxes of half the size in each box, in place."""
    return (2 * boxes[:, None] + _OFFSETS.astype(np.int32)).reshape(-1, 3)


def in_grid(boxes, size: int, grid: Grid):
    """Whether boxes begin at a node of the grid."""
    return (size * boxes < np.array(grid.shape)).all(axis=-1)


def find_bricks(sampler: Sampler, capacity: int, chunk: int):
    """(bricks, their number, the capacity that the search needed), compiled.

    Where the capacity is too small for a coarse level, the number needed is a lower
    estimate: bricks below what was left out are not known.
    """
    grid = sampler.grid
    size = coarsest(grid, 8 * capacity)
    boxes = jnp.asarray(all_boxes(grid, size))
    real = jnp.ones(boxes.shape[0], bool)
    needed = jnp.int32(0)
    while True:
        test = lambda box, size=size: sampler.undecided(box, size)
        batch = min(chunk, boxes.shape[0])
        keep = real & jax.lax.map(test, boxes, batch_size=batch)
        count = jnp.sum(keep, dtype=jnp.int32)
        needed = jnp.maximum(needed, count)
        boxes = compact(boxes, keep, capacity)
        if size == BRICK:
            return boxes, jnp.minimum(count, capacity), needed
        size //= 2
        real = jnp.repeat(jnp.arange(capacity) < count, 8)
        boxes = children(boxes)
        real = real & in_grid(boxes, size, grid)


def compact(rows: Int[Array, "m 3"], keep: Bool[Array, " m"], capacity: int):
    """The rows to keep, in their order; zeros after the last."""
    place = jnp.where(keep, prefix_sum(keep.astype(jnp.int32)), capacity)
    out = jnp.zeros((capacity, 3), rows.dtype)
    return out.at[place].set(rows, mode="drop")
