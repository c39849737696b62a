"""Marching squares: the level set of a field in the plane, as oriented polylines.

Walk around a cell counter-clockwise: an edge from an inside to an outside corner is an
exit, the opposite an enter. Each exit is joined to the enter that began the same run of
inside corners, so that inside corners across a diagonal stay apart, and the inside lies
to the left. A cut edge is an exit in exactly one of its two cells: every crossing has
one successor, and the lines close, except at the sides of the grid.

The lines are put in order without a loop over points: the pointers to predecessors are
doubled, which finds the first point of every line (the least number of a closed one)
and the distance to it in log2 steps; one sort by both makes the lines contiguous.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._core import (
    RESULTS,
    GeometryError,
    check_shape,
    failure_where,
    first_failure,
    message,
    safe_divide,
)
from ._marching_cubes import as_float

# Crossings keep this distance from the nodes, in cells: segments have a length then.
_CLEARANCE = 1e-3


class Polylines(eqx.Module):
    """Lines in the plane, one after the other, each in the order of its points.

    - `points`: [v, 2]; the entries from `num_points` on are padding.
    - `following`: [v] the point after each, the first of its line after the last of a
      closed one; v (no point) after the last of an open line and in padding.
    - `line`: [v] the number of the line; v in padding.
    - `result`: `capacity_exceeded`, `nonfinite_input`, `no_surface`.
    - `required_points`: the capacity that is needed.
    """

    points: Float[Array, "v 2"]
    following: Int[Array, " v"]
    line: Int[Array, " v"]
    num_points: Int[Array, ""]
    num_lines: Int[Array, ""]
    result: RESULTS
    required_points: Int[Array, ""]

    @property
    def mask(self) -> Bool[Array, " v"]:
        """True for real points."""
        return jnp.arange(self.points.shape[0]) < self.num_points


def marching_squares(
    values: Float[Array, "x y"],
    origin: Float[Array, " 2"],
    spacing: Float[Array, " 2"],
    level: Float[Array, ""] | float = 0.0,
    *,
    capacity: int,
) -> Polylines:
    """The lines where a field sampled in the plane equals `level`, inside to the left.

    Inside is values < level, strictly; samples that are not finite are outside. Points
    lie on the edges of the grid at t = (level - f0) / (f1 - f0), at least 1/1000 of a
    cell from the nodes, and have the derivatives of this formula. A line is closed
    unless it leaves the grid.

    **Arguments:**

    - `values`: [x, y] samples at origin + spacing * (i, j), at least 2 along each axis.
    - `capacity`: static; the number of points, at most the number of edges of the grid.
      `required_points` says what is needed.

    **Statuses:** `capacity_exceeded` (the lines are cut where points are missing),
    `nonfinite_input`, `no_surface`.

    Raises `GeometryError` for arrays of other shapes, or a capacity below 1.

    Lorensen and Cline (1987), in the plane.
    """
    values, level = as_float(values, level)
    _check(values, origin, spacing, capacity)
    fixed = lax.stop_gradient(values)
    inside = (fixed < lax.stop_gradient(level)) & jnp.isfinite(fixed)
    cut = _cut_edges(inside)
    needed = jnp.sum(cut)
    # Numbers in the order of the edges: first those along x, then those along y.
    edges = jnp.nonzero(cut, size=capacity, fill_value=cut.shape[0])[0]
    rank = jnp.cumsum(cut) - 1
    place = _places(edges, values.shape)
    successor = _successors(place, inside, cut, rank, capacity)
    order, head, following = _in_order(successor, jnp.minimum(needed, capacity))
    points = _points(place, values, level, origin, spacing)[order]
    num = jnp.minimum(needed, capacity).astype(jnp.int32)
    real = jnp.arange(capacity) < num
    starts = real & (head[order] == order)
    line = jnp.where(real, jnp.cumsum(starts) - 1, capacity).astype(jnp.int32)
    result = first_failure(
        failure_where(needed > capacity, RESULTS.capacity_exceeded),
        failure_where(~jnp.all(jnp.isfinite(values)), RESULTS.nonfinite_input),
        failure_where(needed == 0, RESULTS.no_surface),
    )
    points = jnp.where(real[:, None], points, 0.0)
    lines = jnp.sum(starts)
    return Polylines(points, following, line, num, lines, result, needed)


def _check(values, origin, spacing, capacity):
    check_shape("values", values, (None, None))
    check_shape("origin", origin, (2,))
    check_shape("spacing", spacing, (2,))
    if capacity < 1 or min(values.shape) < 2:
        raise GeometryError(
            message(
                "a grid has at least 2 nodes an axis and a capacity is at least 1",
                f"values of shape {values.shape}, capacity {capacity}",
                "Sample a finer grid, or raise the capacity.",
            )
        )


class _Edges(eqx.Module):
    """Cut edges: axis and lower node."""

    axis: Int[Array, " v"]
    x: Int[Array, " v"]
    y: Int[Array, " v"]


def _cut_edges(inside):
    """Flags of all edges: those along x, [x, y] of their lower nodes, then along y."""
    along_x = jnp.pad(inside[1:] ^ inside[:-1], ((0, 1), (0, 0)))
    along_y = jnp.pad(inside[:, 1:] ^ inside[:, :-1], ((0, 0), (0, 1)))
    return jnp.concatenate([along_x.reshape(-1), along_y.reshape(-1)])


def _places(edges, shape) -> _Edges:
    size = int(np.prod(shape))
    axis = (edges >= size).astype(jnp.int32)
    node = jnp.minimum(edges - axis * size, size - 1)
    return _Edges(axis, node // shape[1], node % shape[1])


def _successors(place: _Edges, inside, cut, rank, capacity):
    """The number of the next crossing; `capacity` where the grid ends."""
    nx, ny = inside.shape
    lower = inside[place.x, place.y]
    along_x = place.axis == 0
    # The cell in which the edge is an exit, and the number of the edge in its walk.
    x = place.x - jnp.where(along_x, 0, lower)
    y = place.y - jnp.where(along_x, ~lower, 0)
    exit_edge = jnp.where(along_x, jnp.where(lower, 0, 2), jnp.where(lower, 1, 3))
    exists = (x >= 0) & (y >= 0) & (x < nx - 1) & (y < ny - 1)

    def corner(k):
        dx, dy = (k == 1) | (k == 2), k >= 2
        at_x = jnp.clip(x + dx, 0, nx - 1)
        return inside[at_x, jnp.clip(y + dy, 0, ny - 1)]

    before = corner((exit_edge - 1) % 4)
    two_before = corner((exit_edge - 2) % 4)
    back = jnp.where(before, jnp.where(two_before, 3, 2), 1)
    enter = (exit_edge - back) % 4
    # Edges 0 to 3: the bottom, right, top and left side of the cell.
    axis = enter % 2
    node = (x + (enter == 1)) * ny + y + (enter == 2)
    index = jnp.clip(axis * nx * ny + node, 0, cut.shape[0] - 1)
    number = rank[index]
    return jnp.where(exists & (number < capacity), number, capacity)


def _in_order(successor, num):
    """The order of the points, the first point of each one's line, and the place in
    the order of the point that follows."""
    size = successor.shape[0]
    index = jnp.arange(size)
    real = index < num
    successor = jnp.where(real, successor, size)
    before = index.at[successor].set(index, mode="drop")
    held = jnp.zeros(size, bool).at[successor].set(real, mode="drop")
    # The first point of an open line has no predecessor: it counts least.
    least = jnp.where(held, index, index - size)
    steps = max(int(size - 1).bit_length(), 1)

    def reach(_, state):
        least, jump = state
        return jnp.minimum(least, least[jump]), jump[jump]

    least, _ = lax.fori_loop(0, steps, reach, (least, before))
    head = jnp.where(least < 0, least + size, least)
    start = head == index
    jump = jnp.where(start, index, before)

    def count(_, state):
        distance, jump = state
        return distance + distance[jump], jump[jump]

    distance = jnp.where(start, 0, 1)
    distance, _ = lax.fori_loop(0, steps, count, (distance, jump))
    order = jnp.lexsort((distance, head, ~real))
    place = jnp.zeros(size + 1, jnp.int32).at[order].set(index.astype(jnp.int32))
    place = place.at[size].set(size)
    return order, head, place[successor[order]]


def _points(place: _Edges, values, level, origin, spacing):
    nx, ny = values.shape
    along_x = place.axis == 0
    f0 = values[place.x, place.y]
    far_x = jnp.minimum(place.x + along_x, nx - 1)
    f1 = values[far_x, jnp.minimum(place.y + ~along_x, ny - 1)]
    sound = jnp.isfinite(f0) & jnp.isfinite(f1)
    f0, f1 = jnp.where(sound, f0, level - 1), jnp.where(sound, f1, level + 1)
    t = jnp.clip(safe_divide(level - f0, f1 - f0), _CLEARANCE, 1 - _CLEARANCE)
    node = jnp.stack([place.x, place.y], axis=-1)
    ahead = jnp.stack([along_x, ~along_x], axis=-1)
    return origin + spacing * (node + jnp.where(ahead, t[:, None], 0.0))
