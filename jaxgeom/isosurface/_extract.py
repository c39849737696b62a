"""The host form of every extractor: measure, size, run, trim."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._core import RESULTS, GeometryError, message, runtime_token
from ..fields import NarrowBand
from ..shapes import Grid
from ._brick_extract import extract_band
from ._extraction import Capacity, Extraction
from ._marching_cubes import MarchingCubes

_MARCHING_CUBES = MarchingCubes()


def extract(
    field: Float[Array, "x y z"] | Callable | NarrowBand,
    grid: Grid | None = None,
    level: Float[Array, ""] | float = 0.0,
    *,
    method=_MARCHING_CUBES,
    closed: bool = False,
) -> Extraction:
    """The mesh of exact size where a field equals `level` (host: sizes are measured).

    A cheap pass counts what is needed (about, for some methods: then a second run may
    follow), the capacity is rounded up to a bucket (so that
    similar surfaces share one program), the mesh is extracted and trimmed.

    **Arguments:**

    - `field`: [x, y, z] samples at the nodes of `grid`, or a function of one point [3],
      or a `NarrowBand`, which has its own grid and level: work and memory then grow
      with the area of the surface.
    - `method`: the settings of an extractor. It is given the samples and, where
      `field` is a function, the function as `field=`. A band takes `MarchingCubes`.
    - `closed`: surround the grid by a layer of outside nodes, so that a surface that
      leaves the grid is closed half a cell beyond its sides.

    **Statuses:** as the extractor's, less `capacity_exceeded`.

        ball = extract(lambda p: jnp.linalg.norm(p) - 0.7, grid).mesh
    """
    token = runtime_token()
    if isinstance(field, NarrowBand):
        _check_band(grid, method, closed)
        return extract_band(field, method, token)
    function = field if callable(field) else None
    values = jnp.asarray(field) if function is None else _sample(field, grid)
    # A Python number would be a constant of the program: one compilation per level.
    level = jnp.asarray(level, jnp.result_type(values.dtype, float))
    if closed:
        values, grid = _pad(values, grid, level)
    needed = jax.device_get(_measure(method, values, level, token))
    sizes = (int(needed.vertices), int(needed.faces), int(needed.cells))
    capacity = Capacity.holding(*sizes)
    out = _run(method, values, grid, level, capacity, function, token)
    if bool(out.result == RESULTS.capacity_exceeded):
        # What is needed is known now: one more run is enough.
        needed = out.required_vertices, out.required_faces, out.required_cells
        capacity = Capacity.holding(*(int(n) for n in needed))
        out = _run(method, values, grid, level, capacity, function, token)
    return eqx.tree_at(lambda e: e.mesh, out, out.mesh.trim())


def pad_outside(
    values: Float[Array, "x y z"], grid: Grid, level: Float[Array, ""] | float = 0.0
) -> tuple[Float[Array, "x+2 y+2 z+2"], Grid]:
    """The values with a layer of outside samples around them, and their grid.

    The new samples mirror the old ones about the level, so that the closing faces lie
    halfway between the old sides and the new ones.
    """
    values = jnp.asarray(values)
    level = jnp.asarray(level, values.dtype)
    inner = (slice(1, -1),) * 3
    shape = tuple(n + 2 for n in values.shape)
    # The rim of the new layer has no inside neighbor: any outside value will do.
    padded = jnp.full(shape, level + 1, values.dtype).at[inner].set(values)
    for axis in range(3):
        for end in (0, -1):
            side = lax.index_in_dim(values, end, axis, keepdims=False)
            depth = jnp.abs(jnp.where(jnp.isfinite(side), side - level, 1.0))
            where = (*inner[:axis], end, *inner[axis + 1 :])
            padded = padded.at[where].set(level + depth)
    return padded, Grid(grid.origin - grid.spacing, grid.spacing, shape)


def _check_band(grid, method, closed):
    if grid is not None or closed or not isinstance(method, MarchingCubes):
        raise GeometryError(
            message(
                "a narrow band is extracted by MarchingCubes, on its own grid",
                f"grid={grid}, method={method}, closed={closed}",
                "Give grid, level and `closed` to `NarrowBand.around`.",
            )
        )


@eqx.filter_jit
def _sample(field, grid):
    """The field at all nodes, one layer at a time to bound the memory."""
    layers = lax.map(jax.vmap(jax.vmap(field)), grid.nodes())
    return layers.reshape(grid.shape)


_pad = eqx.filter_jit(pad_outside)


@eqx.filter_jit
def _measure(method, values, level, token):
    return method.measure(values, level, token=token)


@eqx.filter_jit
def _run(method, values, grid, level, capacity, field, token):
    return method(values, grid, level, capacity=capacity, field=field, token=token)
