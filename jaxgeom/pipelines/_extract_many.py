"""The meshes of a batch of fields, in two compiled calls."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import RESULTS, GeometryError, message, runtime_token
from ..isosurface import Capacity, Extraction, MarchingCubes, pad_outside
from ..shapes import Grid
from ._devices import gathered, on_each, placed


def extract_many(
    fields: Float[Array, "b x y z"] | Callable,
    grid: Grid,
    level: Float[Array, " b"] | float = 0.0,
    *,
    method=None,
    closed: bool = False,
) -> list[Extraction]:
    """The mesh of every field of a batch, on one grid, each with its own status.

    All fields are sampled and measured in one compiled call and all meshes extracted
    in another, one after the other on each local device; the largest mesh decides the
    capacity. Every extraction is that of `isosurface.extract`.

    **Arguments:** as `extract`, and

    - `fields`: [b, x, y, z] samples at the nodes of `grid`, or fields of one kind with
      a leading axis b at every array, as `jax.vmap` makes them.
    - `level`: one for all, or one for each [b].
    - `method`: the settings of an extractor, `MarchingCubes()` by default.

    **Statuses:** as `extract`; a field that does not meet the level is `no_surface`,
    alone. Raises `GeometryError` for what is no batch.

        balls = extract_many(jax.vmap(fields.Sphere)(jnp.array([0.3, 0.5])), grid)
    """
    method = MarchingCubes() if method is None else method
    device = lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x
    arrays, fixed = eqx.partition(jax.tree.map(device, fields), eqx.is_array)
    b = _length(arrays, grid if fixed is None else None)
    dtype = jnp.result_type(grid.spacing, float)
    levels = np.broadcast_to(np.asarray(level, dtype), (b,))
    items, mesh = placed((arrays, levels))
    token = runtime_token()
    samples, needed = _sample(items, (grid, token), fixed, method, closed, mesh)
    if closed:
        grid = Grid(grid.origin - grid.spacing, grid.spacing, samples.shape[1:])

    def run(counts):
        most = (int(np.max(np.asarray(x))) for x in counts)
        settings = (fixed, method, Capacity.holding(*most))
        return _extract((*items, samples), (grid, token), settings, mesh)

    found = run((needed.vertices, needed.faces, needed.cells))
    if np.any(np.asarray(found.result == RESULTS.capacity_exceeded)):
        # What is needed is known now: one more run is enough.
        counts = (found.required_vertices, found.required_faces, found.required_cells)
        found = run(counts)
    found = gathered(found, b)
    rows = (jax.tree.map(lambda x, i=i: x[i], found) for i in range(b))
    return [eqx.tree_at(lambda e: e.mesh, row, row.mesh.trim()) for row in rows]


def _length(arrays, grid) -> int:
    """The size of the batch."""
    shapes = [np.shape(x) for x in jax.tree.leaves(arrays)]
    sizes = {shape[0] if shape else None for shape in shapes}
    wrong = grid is not None and {shape[1:] for shape in shapes} != {grid.shape}
    if len(sizes) != 1 or not all(sizes) or wrong:
        raise GeometryError(
            message(
                "fields must be samples [b, x, y, z] at the nodes of the grid, or "
                "fields whose arrays all have a leading axis b",
                f"arrays of shapes {shapes}",
                "Make a batch by jax.vmap, or call isosurface.extract.",
            )
        )
    return sizes.pop()


@eqx.filter_jit
def _sample(items, given, fixed, method, closed, mesh):
    """The values of every field, and the sizes that its mesh needs."""

    def run(items, given):
        grid, token = given

        def one(item):
            arrays, level = item
            field = eqx.combine(arrays, fixed)
            if callable(field):
                # One layer at a time, to bound the memory.
                values = jax.lax.map(jax.vmap(jax.vmap(field)), grid.nodes())
            else:
                values = jnp.asarray(field)
            level = level.astype(jnp.result_type(values, level))
            if closed:
                values, _ = pad_outside(values, grid, level)
            return values, method.measure(values, level, token=token)

        return jax.lax.map(one, items)

    return on_each(run, mesh)(items, given)


@eqx.filter_jit
def _extract(items, given, settings, mesh):
    """The mesh of every field."""
    fixed, method, capacity = settings

    def run(items, given):
        grid, token = given

        def one(item):
            arrays, level, values = item
            field = eqx.combine(arrays, fixed)
            return method(
                values,
                grid,
                level.astype(jnp.result_type(values, level)),
                capacity=capacity,
                field=field if callable(field) else None,
                token=token,
            )

        return jax.lax.map(one, items)

    return on_each(run, mesh)(items, given)
