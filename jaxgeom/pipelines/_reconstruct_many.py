"""The meshes of a ragged batch of scans, in two compiled calls."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core import (
    RESULTS,
    GeometryError,
    failure_where,
    first_failure,
    message,
    runtime_token,
)
from ..isosurface import Capacity, pad_outside
from ..meshes import keep_faces, large_components
from ..normals import LocalPlanes
from ..reconstruction import ScreenedPoisson
from ..shapes import Grid, PointCloud
from ._devices import gathered, on_each, placed
from ._prepare import is_degenerate, unusable
from ._reconstruct import (
    EXTRACTOR,
    Reconstruction,
    check_resolution,
    notes_on,
    to_user,
    with_attributes,
)

_FEWEST = 4


class _Way(eqx.Module):
    """x_user = scale * x + center of one scan (float64, host), and its dtype.

    `status` is what is wrong with the scan; a hopeless one has no mesh.
    """

    center: np.ndarray
    scale: float
    dtype: np.dtype
    status: RESULTS
    is_hopeless: bool = False


def reconstruct_many(
    clouds: PointCloud,
    *,
    resolution: int = 64,
    method=None,
    extractor=None,
    orientation=None,
    padding: float = 0.1,
    min_component: float = 0.01,
) -> list[Reconstruction]:
    """The watertight mesh of every scan of a ragged batch, each with its own status.

    All fields are solved in one compiled call and all meshes extracted in another, one
    scan after the other on each local device; the largest mesh decides the capacity.
    Programs are shared by batches of one size whose scans fill the same bucket.

    **Arguments:** as `reconstruct`, and

    - `clouds`: scans as one batch [b, n, 3] with masks, of `jaxgeom.stack`. Points and
      normals that are not finite are ignored; attributes are not carried along.
    - `min_component`: remove bodies with fewer than this share of the faces of the
      largest.

    **Statuses:** those of `reconstruct_jit`; for what `reconstruct` refuses
    `too_few_points` (fewer than 4), `degenerate_input` (points that coincide, lie on a
    line, or without normals in a plane; or no surface was found) and `zero_normals`
    (most are zero), each with an empty mesh; `zero_normals` with a mesh where some
    were ignored. None is ever raised, and the others are what they would be alone.
    `topology` is None: see `meshes.topology`. Raises `GeometryError` for clouds that
    are no batch.
    """
    _check_batch(clouds)
    resolution = check_resolution(resolution)
    method = ScreenedPoisson() if method is None else method
    extractor = EXTRACTOR if extractor is None else extractor
    orientation = LocalPlanes() if orientation is None else orientation
    unit, ways = _unit_boxes(clouds)
    b, token = len(ways), runtime_token()
    items, mesh = placed(unit)
    settings = (method, orientation, extractor, resolution)
    share = jnp.asarray(padding, unit.points.dtype)
    fields, needed = _solve(items, (share, token), settings, mesh)
    most = jax.tree.map(lambda x: int(np.max(np.asarray(x))), needed)
    capacity = Capacity.holding(*jax.tree.leaves(most))
    least = jnp.asarray(min_component, unit.points.dtype)
    meshes, more = _extract((items, fields), (least, token), extractor, capacity, mesh)
    fields, meshes, more, needed = gathered((fields, meshes, more, needed), b)
    rows = (jax.tree.map(lambda x, i=i: x[i], (fields, meshes, more)) for i in range(b))
    nothing = np.asarray(needed.faces) == 0
    return [
        _finished(*row, way, empty)
        for row, way, empty in zip(rows, ways, nothing, strict=True)
    ]


def _check_batch(clouds):
    if clouds.points.ndim != 3:
        raise GeometryError(
            message(
                "clouds must be a batch of points [b, n, 3]",
                f"points of shape {tuple(clouds.points.shape)}",
                "Make a batch with jaxgeom.stack, or call reconstruct.",
            )
        )


def _unit_boxes(clouds):
    """Every scan in a box of side one, the ways back, and what is wrong (host)."""
    points = np.asarray(clouds.points, np.float64)
    mask = np.asarray(clouds.mask) & np.isfinite(points).all(axis=-1)
    oriented = clouds.normals is not None
    normals = np.asarray(clouds.normals) if oriented else None
    bad = mask & unusable(normals) if oriented else np.zeros(mask.shape, bool)
    ways, unit = [], np.zeros(points.shape)
    for i, (row, there) in enumerate(zip(points, mask, strict=True)):
        way = _way_of(row[there], bad[i][there], oriented, clouds.points.dtype)
        mask[i] &= ~bad[i] & (not way.is_hopeless)
        unit[i] = np.where(mask[i][:, None], (row - way.center) / way.scale, 0)
        ways.append(way)
    dtype = jax.dtypes.canonicalize_dtype(clouds.points.dtype)
    normals = np.where(mask[..., None], normals, 0).astype(dtype) if oriented else None
    where = lambda c: (c.points, c.normals, c.mask, c.attributes)
    boxed = (unit.astype(dtype), normals, mask, {})
    return eqx.tree_at(where, clouds, boxed, is_leaf=lambda x: x is None), ways


def _way_of(points, bad, oriented, dtype):
    """The box of the points of a scan, and what `prepare` would say of them."""
    hopeless = lambda status: _Way(np.zeros(3), 1.0, dtype, status, True)
    if len(points) < _FEWEST:
        return hopeless(RESULTS.too_few_points)
    low, high = points.min(axis=0), points.max(axis=0)
    scale, center = float((high - low).max()), (low + high) / 2
    if scale == 0 or is_degenerate((points - center) / scale, oriented):
        return hopeless(RESULTS.degenerate_input)
    if bad.mean() > 0.5:
        return hopeless(RESULTS.zero_normals)
    status = RESULTS.zero_normals if bad.any() else RESULTS.successful
    return _Way(center, scale, dtype, status)


@eqx.filter_jit
def _solve(clouds, common, settings, mesh):
    """The field of every scan, and the sizes that its mesh needs."""
    method, orientation, extractor, resolution = settings

    def run(clouds, given):
        padding, token = given

        def one(cloud):
            cloud = orientation(cloud) if cloud.normals is None else cloud
            grid = Grid.around(cloud, resolution=resolution, padding=padding)
            field = method(cloud, grid, token=token)
            values, _ = pad_outside(field.values, field.grid, field.level)
            return field, extractor.measure(values, field.level)

        return jax.lax.map(one, clouds)

    return on_each(run, mesh)(clouds, common)


@eqx.filter_jit
def _extract(items, common, extractor, capacity, mesh):
    """The mesh of every field, closed, without specks, with the density of samples."""

    def run(items, given):
        least, token = given

        def one(item):
            cloud, field = item
            values, grid = pad_outside(field.values, field.grid, field.level)
            found = extractor(values, grid, field.level, capacity=capacity, token=token)
            shown = with_attributes(found.mesh, field, cloud, token)
            return keep_faces(
                shown, large_components(shown, min_fraction=least)
            ), found.result

        return jax.lax.map(one, items)

    return on_each(run, mesh)(items, common)


def _finished(field, mesh, status, way, empty) -> Reconstruction:
    """One scan back in its unit and place, with its status."""
    result = first_failure(way.status, first_failure(field.result, status))
    if not way.is_hopeless:
        nothing = failure_where(jnp.asarray(empty), RESULTS.degenerate_input)
        result = first_failure(result, nothing)
    notes = () if way.is_hopeless else notes_on(field)
    mesh, field = to_user(mesh.trim(), field, way)
    return Reconstruction(mesh, field, result, field.stats, None, notes)
