"""Edges and corners of a body that no cell sees by its own cut edges.

A corner may lie in a cell whose edges meet one or two of its three planes only, or in a
cell of which all nodes are on one side. The cells around do see its planes. So every
patch pools its planes and those of the patches in its quads, once for each quad,

    H = sum n n^T,  r = sum n n . (p - c),  c the mean crossing of the patch itself,

and the point c + (H + w I)^-1 r, with Tikhonov's steps of `_qef.py`, is a candidate for
its vertex, as near to c as the planes leave it. It is taken where

- it lies in the cell of the patch, or beyond one side of it in a cell without surface,
- the field says that it is on the surface,
- the pooled normals have more directions than its own, or its vertex was held at a side
  of the cell and they have two: on smooth surfaces the own crossings are nearer.

A side of a cell toward a cell without surface has no cut edge. So the vertex stays in
its quadrant around each cut edge of its patch, where the triangles of `_dual.py` face
outward; and no other vertex of its quads can be in that cell.

A vertex where the tangent planes meet, inside the cell or not: Kobbelt, Botsch,
Schwanecke and Seidel (2001).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..shapes import Grid
from ._bits import WORD
from ._dual import Dual
from ._hermite import CLEARANCE
from ._patches import corner_indices
from ._qef import Planes, approach, times
from ._vertices import Samples

# Tikhonov's steps and weight: three planes of which one has 1/50 of the crossings are
# met but for rounding: (w / (1/50 + w))^4 = 6e-10.
_STEPS = 4
_WEIGHT = 1e-4
# The second eigenvalue of H from which on there is an edge: two planes that meet at 16
# degrees and have half of the crossings each have 0.02.
_TURN = 0.02
# The largest value at a vertex that is taken, relative to the largest change of the
# field along a cut edge of the patch.
_MISFIT = 1e-2
# The distance of a candidate from the sides of cells, in cells: half of that of others,
# so that a corner beside a side is missed by less than 1/1000.
_CLEARANCE = CLEARANCE / 2


class Sums(eqx.Module):
    """Sums over planes: of n n^T, of n (n . p), and their number; the points from
    the corner of a cell or from the lower node of an edge."""

    normal: Float[Array, "6 k"]
    offset: Float[Array, "3 k"]
    number: Float[Array, " k"]


def take_features(
    own: Float[Array, "3 v"],
    planes: Planes,
    weight: Float[Array, ""],
    field: Callable,
    values: Float[Array, "x y z"],
    dual: Dual,
    grid: Grid,
    level: Float[Array, ""],
) -> Float[Array, "3 v"]:
    """The vertices, or the pooled candidates where these are better.

    `own` are the vertices that `planes`, those of every patch, give by themselves with
    this weight of their mean. Both are in units of the widest spacing, from the corner
    of the cell.
    """
    size = grid.spacing / jnp.max(grid.spacing)
    pooled, change = pool(planes, values, dual, size)
    point = off_sides(approach(pooled, _WEIGHT, _STEPS), size)
    # Which one is taken is a choice: it has no derivative.
    fixed = lax.stop_gradient((point, own, change, planes, pooled, weight))
    take = is_better(*fixed, field, dual, grid, level)
    return jnp.where(take, point, own)


def off_sides(point: Float[Array, "3 v"], size) -> Float[Array, "3 v"]:
    """Points nearer to a side of the cell than `_CLEARANCE`, moved to there."""
    place = point / size[:, None]
    for side in (0, 1):
        past = place - side
        held = side + jnp.where(past < 0, -_CLEARANCE, _CLEARANCE)
        place = jnp.where(jnp.abs(past) < _CLEARANCE, held, place)
    return size[:, None] * place


def is_better(
    point, own, change, planes, pooled, weight, field, dual: Dual, grid, level
):
    """Whether the candidates are allowed, on the surface, and see what `own` do not."""
    size = grid.spacing / jnp.max(grid.spacing)
    place, aside = (point / size[:, None]).T, jnp.abs(own / size[:, None] - 0.5)
    aside = jnp.any(aside >= 0.5 - 2 * CLEARANCE, axis=0)
    corner = corner_indices(dual.patches.node, grid.shape)
    found = jax.vmap(field)(grid.origin + grid.spacing * (corner + place)) - level
    near = jnp.abs(found) < _MISFIT * change
    # What the weight of the mean draws away from is not seen well.
    alone = num_planes(planes.normal, jnp.maximum(_TURN / 2, 5 * weight))
    seen = num_planes(pooled.normal, _TURN / 2)
    more = (seen > alone) | ((seen > 1) & aside)
    return near & more & is_allowed(place, dual, grid.shape)


def num_planes(normal: Float[Array, "6 k"], least) -> Int[Array, " k"]:
    """How many directions the normals of H, of trace 1, have: 1, 2, or 3 where the
    third has a part of at least about `least`."""
    xx, xy, xz, yy, yz, zz = normal
    second = xx * yy - xy * xy + yy * zz - yz * yz + zz * xx - xz * xz
    third = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz)
    third = third + xz * (xy * yz - yy * xz)
    # The products of two and of three eigenvalues; the first one is near 1.
    two, three = second > _TURN, third > least * second
    return 1 + two.astype(jnp.int32) + (two & three).astype(jnp.int32)


def pool(planes: Planes, values, dual: Dual, size) -> tuple[Planes, Float[Array, " v"]]:
    """For every patch the planes of all patches in its quads and its own, about its own
    mean crossing, and the largest change of the field along its cut edges."""
    patches = dual.patches
    number = jnp.sum(patches.held, axis=0).astype(planes.mean.dtype)
    offset = planes.right + jnp.stack(times(planes.normal, planes.mean))
    own = Sums(number * planes.normal, number * offset, number)
    around = _at_edges(own, dual, size)
    samples = Samples(values, dual.edges)
    change = jnp.abs(samples.along(1) - samples.along(0))

    def add(state, slot):
        sums, largest = state
        edge, code, held = slot
        corner = [(code >> (2 + d) & 1) * size[d] for d in range(3)]
        there = jax.tree.map(lambda x: jnp.where(held, x[..., edge], 0.0), around)
        there = shift(there, corner)
        largest = jnp.maximum(largest, jnp.where(held, change[edge], 0.0))
        return (jax.tree.map(jnp.add, sums, there), largest), None

    start = own, jnp.zeros_like(number)
    slots = patches.edge, patches.code, patches.held
    sums, change = lax.scan(add, start, slots)[0]
    number = jnp.maximum(sums.number, 1)
    right = sums.offset - jnp.stack(times(sums.normal, planes.mean))
    normal, right = sums.normal / number, right / number
    return Planes(planes.mean, normal, right, planes.direction), change


def _at_edges(own: Sums, dual: Dual, size) -> Sums:
    """The sums over the four patches around every cut edge, from its lower node."""
    axis, total = dual.edges.axis, None
    for i, quad in enumerate(dual.quads):
        # The cells of `_dual.py`: one step back along both axes, along the first, ...
        back_u = jnp.where(dual.inside, i in (0, 3), i in (0, 1))
        back_v = jnp.where(dual.inside, i in (0, 1), i in (0, 3))
        back = [
            -size[d]
            * jnp.where(axis == (d + 2) % 3, back_u, (axis == (d + 1) % 3) & back_v)
            for d in range(3)
        ]
        there = jax.tree.map(
            lambda x, q=quad: jnp.where(dual.held, x.at[..., q].get(mode="clip"), 0.0),
            own,
        )
        there = shift(there, back)
        total = there if total is None else jax.tree.map(jnp.add, total, there)
    return total


def shift(sums: Sums, by) -> Sums:
    """The sums of planes moved by three numbers: offsets grow by H times them."""
    moved = jnp.stack(times(sums.normal, by))
    return eqx.tree_at(lambda s: s.offset, sums, sums.offset + moved)


def is_allowed(place: Float[Array, "v 3"], dual: Dual, shape) -> Bool[Array, " v"]:
    """Whether a point, in cells from the corner of the cell of its patch, is in that
    cell, or beyond one of its sides in a cell without surface."""
    step = (place > 1).astype(jnp.int32) - (place < 0)
    there = corner_indices(dual.patches.node, shape) + step
    last = jnp.array(shape, jnp.int32) - 2
    near = jnp.abs(place - 0.5) < 1.5 - _CLEARANCE
    near = jnp.all(near & (there >= 0) & (there <= last), axis=-1)
    x, y, z = jnp.clip(there, 0, last).T
    word = dual.bits.cells[x, y, z // WORD]
    empty = (word >> (z % WORD).astype(jnp.uint32) & 1) == 0
    steps = jnp.sum(jnp.abs(step), axis=-1)
    return (steps == 0) | ((steps == 1) & near & empty)
