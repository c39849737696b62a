"""A field sampled near its surface only."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from .._core import (
    RESULTS,
    GeometryError,
    bucket,
    failure_where,
    first_failure,
    from_host,
    host_zeros,
    message,
)
from ..shapes import Grid
from ._bricks import (
    BRICK,
    NODES,
    Sampler,
    all_boxes,
    check_size,
    children,
    coarsest,
    find_bricks,
    in_grid,
    morton,
)
from ._field import AbstractField, claims

# Host form: bricks and boxes per call, so that one program serves every size.
_BRICKS, _TOGETHER, _BOXES = 1024, 64, 32768
# Values this close to zero, of the largest of the brick, may differ in sign between
# two bricks that share the node: no such brick is dropped.
_ROUNDINGS = 1024


class NarrowBand(eqx.Module):
    """A field, less its level, on the bricks of 8^3 cells that may hold surface.

    A brick holds the nodes 8 i ... 8 i + 8 along each axis; neighbors share a layer of
    nodes. At most 1024 bricks along an axis. Make one by `NarrowBand.around` or
    `narrow_band`; `isosurface.extract` makes it a mesh.

    - `grid`: the whole lattice; no array has its size.
    - `bricks`: [b, 3], the index i of each brick, along a Morton curve; those from
      `num_bricks` on are padding.
    - `values`: [b, 9, 9, 9], the values; differentiable.
    - `required_bricks`, `result`: the capacity that was needed; `capacity_exceeded` (a
      band with holes) or `no_surface`.
    """

    grid: Grid
    bricks: Int[Array, "b 3"]
    values: Float[Array, "b n n n"]
    num_bricks: Int[Array, ""]
    required_bricks: Int[Array, ""]
    result: RESULTS

    @staticmethod
    def around(
        field: Callable,
        grid: Grid,
        level: Float[Array, ""] | float = 0.0,
        *,
        lipschitz: Float[Array, ""] | float | None = None,
        width: Float[Array, ""] | float = 0.0,
        closed: bool = False,
    ) -> "NarrowBand":
        """The band around the surface where a field equals `level` (host: measures).

        Work and memory grow with the area of the surface. Bricks that turn out to hold
        none are dropped.

        **Arguments:**

        - `lipschitz`: L with |f(x) - f(y)| <= L |x - y|, by default what the field
          claims. Too small a value loses parts of the surface, which the extraction
          reports where it meets the gap; `inf` keeps every brick.
        - `width`: keeps all points nearer than this to the surface, a length.
        - `closed`: surround the grid by a layer of outside nodes, so that a surface
          that leaves the grid is closed half a cell beyond its sides.

            ball = Sphere(0.4)
            grid = Grid(jnp.full(3, -0.5), jnp.full(3, 1 / 1023), (1024, 1024, 1024))
            mesh = extract(NarrowBand.around(ball, grid)).mesh

        Raises `GeometryError` for more than 8192 nodes along an axis, or where
        `lipschitz` is not given and the field claims no finite constant.
        """
        if lipschitz is None and not jnp.isfinite(claims(field).lipschitz):
            raise _no_slope(f"a field that claims {float(claims(field).lipschitz)}")
        sampler = _sampler(field, grid, level, lipschitz, width, closed)
        bricks, values = _sampled(sampler, _search(sampler))
        count = jnp.int32(len(bricks))
        size = bucket(len(bricks))
        padded = np.zeros((size, 3), np.int32)
        padded[: len(bricks)] = bricks
        return NarrowBand(
            sampler.grid,
            jnp.asarray(padded),
            values,
            count,
            count,
            failure_where(count == 0, RESULTS.no_surface),
        )

    def mask(self):
        """True for the real bricks [b]."""
        return jnp.arange(self.bricks.shape[0]) < self.num_bricks

    def find(self, bricks: Int[Array, "*q 3"]) -> Int[Array, "*q"]:
        """Where bricks are stored; the capacity for those that are not."""
        last = jnp.iinfo(jnp.int32).max
        keys = jnp.where(self.mask(), morton(self.bricks), last)
        counts = np.array([-(-n // BRICK) for n in self.grid.shape])
        exists = jnp.all((bricks >= 0) & (bricks < counts), axis=-1)
        wanted = jnp.where(exists, morton(bricks), last - 1)
        slot = jnp.searchsorted(keys, wanted).astype(jnp.int32)
        found = keys.at[slot].get(mode="clip") == wanted
        return jnp.where(found, slot, self.bricks.shape[0])


def narrow_band(
    field: Callable,
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    lipschitz: Float[Array, ""] | float | None = None,
    capacity: int,
    width: Float[Array, ""] | float = 0.0,
    closed: bool = False,
    chunk: int = 65536,
) -> NarrowBand:
    """`NarrowBand.around` at a fixed capacity of bricks, for use under jit, vmap, grad.

    The values have the derivatives of the field; which bricks are kept has none.
    `chunk` nodes are evaluated at a time. Where the field is no `AbstractField`,
    `lipschitz` must be given; one that claims none, or infinity, keeps every brick.

    **Statuses:** `capacity_exceeded`, with the need in `required_bricks` (a lower
    estimate where a coarse level of the search overflowed: raise it again);
    `no_surface`.
    """
    if capacity < 1:
        raise GeometryError(
            message(
                "the capacity must be at least 1",
                f"{capacity}",
                "Measure it: `NarrowBand.around(...).num_bricks`.",
            )
        )
    if lipschitz is None and not isinstance(field, AbstractField):
        raise _no_slope("a function that claims nothing")
    sampler = _sampler(field, grid, level, lipschitz, width, closed)
    # Which bricks are kept is piecewise constant: it has no derivative.
    fixed = jax.tree.map(
        lambda x: lax.stop_gradient(x) if eqx.is_array(x) else x, sampler
    )
    bricks, count, needed = find_bricks(fixed, capacity, chunk)
    together = max(1, min(chunk // NODES**3, capacity))
    values = lax.map(sampler.brick, bricks, batch_size=together)
    result = first_failure(
        failure_where(needed > capacity, RESULTS.capacity_exceeded),
        failure_where(count == 0, RESULTS.no_surface),
    )
    return NarrowBand(sampler.grid, bricks, values, count, needed, result)


def _no_slope(given):
    return GeometryError(
        message(
            "a narrow band needs a finite Lipschitz constant of its field",
            given,
            "Pass lipschitz=..., or inf to sample everywhere.",
        )
    )


def _sampler(field, grid, level, lipschitz, width, closed):
    check_size(grid)
    if lipschitz is None:
        lipschitz = claims(field).lipschitz
    dtype = jnp.result_type(grid.origin, grid.spacing, float)
    origin, spacing = (jnp.asarray(x, dtype) for x in (grid.origin, grid.spacing))
    grid = Grid(origin, spacing, grid.shape)
    if closed:
        shape = tuple(n + 2 for n in grid.shape)
        grid = Grid(origin - spacing, spacing, shape)
    numbers = (jnp.asarray(x, dtype) for x in (level, lipschitz, width))
    return Sampler(field, grid, *numbers, closed)


def _search(sampler) -> Int[np.ndarray, "b 3"]:
    """The undecided bricks, level by level."""
    size = coarsest(sampler.grid, 512)
    boxes = all_boxes(sampler.grid, size)
    while True:
        boxes = boxes[_tested(sampler, boxes, size)]
        if size == BRICK:
            return boxes
        size //= 2
        boxes = children(boxes)
        boxes = boxes[in_grid(boxes, size, sampler.grid)]


def _tested(sampler, boxes, size):
    keep = [
        np.asarray(_undecided(sampler, _rows(boxes, i, _BOXES), jnp.int32(size)))
        for i in range(0, len(boxes), _BOXES)
    ]
    return np.concatenate([*keep, np.zeros(0, bool)])[: len(boxes)]


def _sampled(sampler, bricks):
    """The bricks that hold surface, and the values of a bucket of them."""
    kept, at = [bricks[:0]], 0
    shape = (bucket(len(bricks)), NODES, NODES, NODES)
    values = host_zeros(shape, sampler.grid.origin.dtype)
    for i in range(0, len(bricks), _BRICKS):
        found, near = _values(sampler, _rows(bricks, i, _BRICKS))
        chosen = np.flatnonzero(np.asarray(near)[: len(bricks) - i])
        kept.append(bricks[i + chosen])
        values[at : at + len(chosen)] = np.asarray(found)[chosen]
        at += len(chosen)
    return np.concatenate(kept), from_host(values[: bucket(at)])


def _rows(rows, start, count):
    part = rows[start : start + count]
    return np.pad(part, ((0, count - len(part)), (0, 0)))


@eqx.filter_jit
def _undecided(sampler, boxes, size):
    return jax.vmap(lambda box: sampler.undecided(box, size))(boxes)


@eqx.filter_jit
def _values(sampler, bricks):
    """The values of bricks, and whether some lie within the width of the surface."""
    batches = bricks.reshape(-1, _TOGETHER, 3)
    values = lax.map(jax.vmap(sampler.brick), batches).reshape(-1, NODES, NODES, NODES)
    flat = values.reshape(values.shape[0], -1)
    doubt = _ROUNDINGS * jnp.finfo(flat.dtype).eps * jnp.max(jnp.abs(flat), axis=1)
    reach = jnp.where(sampler.width > 0, sampler.lipschitz * sampler.width, 0) + doubt
    apart = (jnp.min(flat, axis=1) > reach) | (jnp.max(flat, axis=1) < -reach)
    return values, ~apart
