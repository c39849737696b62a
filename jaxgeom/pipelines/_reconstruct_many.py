"""The meshes of a ragged batch of scans, in two compiled calls."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import first_failure, runtime_token
from ..isosurface import Capacity, pad_outside
from ..meshes import topology
from ..normals import LocalPlanes
from ..reconstruction import ScreenedPoisson
from ..shapes import Grid, PointCloud
from ._devices import gathered, on_each, placed
from ._items import items_of, together, weights_together
from ._memory import check_memory
from ._prepare import notes_on_normals
from ._reconstruct import (
    EXTRACTOR,
    Reconstruction,
    check_resolution,
    cleaned,
    notes_on,
    to_user,
    with_attributes,
)


def reconstruct_many(
    clouds: PointCloud,
    *,
    resolution: int = 64,
    method=None,
    extractor=None,
    weights: Float[Array, "b n"] | None = None,
    orientation=None,
    padding: float = 0.1,
    trim: float | None = None,
    min_component: float = 0.01,
) -> list[Reconstruction]:
    """The watertight mesh of every scan of a ragged batch, each with its own status.

    All fields are solved in one compiled call and all meshes extracted in another, one
    scan after the other on each local device; the largest mesh decides the capacity.
    Programs are shared by batches of one size whose scans fill the same bucket.

    **Arguments:** as `reconstruct`, and

    - `clouds`: scans as one batch [b, n, 3] with masks, of `jaxgeom.stack`. Points
      that are not finite are ignored.
    - `weights`: [b, n] confidence of the points.

    **Statuses:** those of `reconstruct_jit`, and for what `reconstruct` refuses
    `too_few_points` (fewer than 4), `degenerate_input` (points that coincide, lie on a
    line, or without normals in a plane) and `zero_normals` (most are), each with an
    empty mesh and the text of the error among the `notes`. None is ever raised, and
    the others are what they would be alone. Raises `GeometryError` for clouds that are
    no batch, and for fields that do not fit the memory of this machine together.
    """
    resolution = check_resolution(resolution)
    method = ScreenedPoisson() if method is None else method
    extractor = EXTRACTOR if extractor is None else extractor
    orientation = LocalPlanes() if orientation is None else orientation
    scans = items_of(clouds, "reconstruct", notes_on_normals, weights)
    size = jnp.zeros(()).dtype.itemsize
    check_memory(resolution, size, len(scans), jax.local_device_count())
    unit = together(scans, clouds.points.shape[1])
    confidence = weights_together(scans, clouds.points.shape[1])
    items, mesh = placed((unit, confidence))
    dtype = jax.dtypes.canonicalize_dtype(unit.points.dtype)
    token = runtime_token()
    settings = (method, orientation, extractor, resolution)
    fields, needed = _solve(items, (jnp.asarray(padding, dtype), token), settings, mesh)
    most = jax.tree.map(lambda x: int(np.max(np.asarray(x))), needed)
    capacity = Capacity.holding(*jax.tree.leaves(most))
    limits = jax.tree.map(lambda x: jnp.asarray(x, dtype), (trim, min_component))
    found = _extract((items[0], fields), (limits, token), extractor, capacity, mesh)
    found = gathered((fields, *found), len(scans))
    rows = (jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(scans)))
    return [_finished(*row, scan) for row, scan in zip(rows, scans, strict=True)]


@eqx.filter_jit
def _solve(items, common, settings, mesh):
    """The field of every scan, and the sizes that its mesh needs."""
    method, orientation, extractor, resolution = settings

    def run(items, given):
        padding, token = given

        def one(item):
            cloud, weights = item
            cloud = orientation(cloud) if cloud.normals is None else cloud
            grid = Grid.around(cloud, resolution=resolution, padding=padding)
            field = method(cloud, grid, weights=weights, token=token)
            values, _ = pad_outside(field.values, field.grid, field.level)
            return field, extractor.measure(values, field.level)

        return jax.lax.map(one, items)

    return on_each(run, mesh)(items, common)


@eqx.filter_jit
def _extract(items, common, extractor, capacity, mesh):
    """The mesh of every field, closed or trimmed, without specks, with the density of
    samples; its status and its check."""

    def run(items, given):
        (trim, least), token = given

        def one(item):
            cloud, field = item
            values, grid = field.values, field.grid
            if trim is None:
                values, grid = pad_outside(values, grid, field.level)
            found = extractor(values, grid, field.level, capacity=capacity, token=token)
            shown = with_attributes(found.mesh, field, cloud, token)
            mesh = cleaned(shown, field.stats.area, trim, least)
            return mesh, found.result, topology(mesh)

        return jax.lax.map(one, items)

    return on_each(run, mesh)(items, common)


def _finished(field, mesh, status, check, item) -> Reconstruction:
    """One scan back in its unit and place, with its status."""
    result, notes = item.refusal, item.ready.notes
    if result is None:
        result, notes = first_failure(field.result, status), notes + notes_on(field)
    mesh, field = to_user(mesh.trim(), field, item.ready)
    return Reconstruction(mesh, field, result, field.stats, check, notes)
