"""Two scans of one thing in, the motion that lays one on the other out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import RESULTS, GeometryError, bucket, message
from ..registration import Registration
from ..shapes import PointCloud
from ..transforms import Affine, Rigid, Similarity
from ._devices import gathered, on_each, placed
from ._pyramid import (
    Pyramid,
    align,
    align_to,
    choose_voxel_size,
    level_rooms,
    target_levels,
    without_sparse_levels,
)

_FEWEST = 6


class MeanAligned(eqx.Module):
    """Start with the centroid of the source on that of the target, unturned."""


def register(
    source: PointCloud | Float[Array, "n 3"],
    target: PointCloud | Float[Array, "m 3"],
    *,
    voxel_size: float | None = None,
    init: Rigid | Similarity | Affine | MeanAligned | None = None,
    pyramid: Pyramid | None = None,
    throw: bool = True,
) -> Registration:
    """The motion target_from_source that lays a scan on another (host form).

    Checks the clouds, centers them in double precision, chooses the voxel size, and
    aligns coarse to fine by `icp`: by default symmetric residuals, a `Tukey` kernel
    whose width follows the residuals, and a shrinking largest distance.

    **Arguments:**

    - `source`, `target`: a `PointCloud`, or points [n, 3], in one unit. Points that are
      not finite are ignored. Normals are used where both have them, and estimated
      otherwise.
    - `voxel_size`: side of the finest voxels; by default such that a voxel with points
      holds two on average.
    - `init`: the transform to start from (identity by default), or `MeanAligned()`.
    - `pyramid`: levels and method; coarse levels with few points are left out.
    - `throw`: raise `GeometryError` for a status that is not success.

    The transform is in double precision. **Statuses:** those of `icp`, for the finest
    level. Raises `GeometryError` for arrays of wrong shape or too few points.
    """
    pyramid = Pyramid() if pyramid is None else pyramid
    clouds = [_checked(source, "source"), _checked(target, "target")]
    center = np.asarray(clouds[1].points, np.float64).mean(axis=0)
    points = [np.asarray(cloud.points, np.float64) - center for cloud in clouds]
    if voxel_size is None:
        voxel_size = max(choose_voxel_size(p) for p in points)
    start = _start(init, *points, center)
    pair = _padded(clouds, points)
    dtype = pair[0].points.dtype
    pyramid = without_sparse_levels(points, voxel_size, pyramid)
    rooms = level_rooms(points, voxel_size, pyramid)
    found = _run(
        *pair, jnp.asarray(voxel_size, dtype), _as(start, dtype), rooms, pyramid
    )
    if throw:
        _raise_for(found)
    moved = _conjugated(_as(found.target_from_source, np.float64), -center)
    return eqx.tree_at(lambda r: r.target_from_source, found, moved)


def register_jit(
    source: PointCloud,
    target: PointCloud,
    *,
    voxel_size: Float[Array, ""],
    rooms: tuple[int, ...],
    init: Rigid | Similarity | Affine | None = None,
    pyramid: Pyramid | None = None,
) -> Registration:
    """The alignment at static sizes: pure, for your own `jax.jit`, `vmap` and `grad`.

    Derivatives reach points and normals; they are those of the minimum on the finest
    level at its pairs.

    **Arguments:** as `register`, and

    - `source`, `target`: of equal size [n, 3] and with normals both or neither; pad
      the shorter and mask it.
    - `voxel_size`: side of the finest voxels.
    - `rooms`: the capacity of every level, such as of `level_rooms`.
    """
    pyramid = Pyramid() if pyramid is None else pyramid
    start = Rigid.identity(source.points.dtype) if init is None else init
    return align(source, target, voxel_size, start, rooms, pyramid)


def register_many(
    sources: PointCloud,
    target: PointCloud,
    *,
    voxel_size: float | None = None,
    init: Rigid | Similarity | Affine | None = None,
    pyramid: Pyramid | None = None,
    rooms: tuple[int | None, ...] | None = None,
    chunk: int = 1,
) -> Registration:
    """The alignments of a batch of scans, in one compiled call; fields are batched.

    **Arguments:** as `register`, and

    - `sources`: ragged scans as one batch [b, n, 3] with masks, of `stack`.
    - `target`: one cloud for all, or a batch [b, m, 3] with one for each.
    - `init`: batched transforms; identity by default.
    - `rooms`: the capacity of every level, such as of `level_rooms`, so that batches
      of one size share one program; by default what this batch needs, without levels
      on which its scans are sparse.
    - `chunk`: how many each device aligns at once; memory grows with it. One at a
      time is fastest on a CPU.

    The batch is divided among all local devices. Every item has its own status; none
    is ever raised. Raises `GeometryError` where the shapes do not go together.
    """
    pyramid = Pyramid() if pyramid is None else pyramid
    _check_batches(sources, target)
    b = sources.points.shape[0]
    shared = target.points.ndim == 2
    if shared:
        target = jax.tree.map(lambda x: np.asarray(x)[None], target)
    batches = [_masked(cloud) for cloud in (sources, target)]
    rows = [points[mask] for points, mask in _rows(batches)]
    some = [points for points in rows if len(points)]
    if voxel_size is None:
        voxel_size = float(np.median([choose_voxel_size(p) for p in some] or [1.0]))
    if rooms is None:
        some = some or [np.zeros((1, 3))]
        pyramid = without_sparse_levels(some, voxel_size, pyramid)
        rooms = level_rooms(some, voxel_size, pyramid)
    center = np.stack([_mean(points) for points in rows[b:]])
    center = np.broadcast_to(center, (b, 3))
    start = _identities(b) if init is None else _as(init, np.float64)
    start = _conjugated(start, center)
    sources, targets = _same_size(batches, center)
    dtype = sources.points.dtype
    size = jnp.asarray(voxel_size, dtype)
    common = None
    if shared:
        common = _target_levels(targets, size, rooms, pyramid)
        targets = None
    items, mesh = placed((sources, targets, _as(start, dtype)))
    found = _run_many(items, common, size, rooms, pyramid, chunk, mesh)
    found = found if mesh is None else gathered(found, b)
    moved = _conjugated(_as(found.target_from_source, np.float64), -center)
    return eqx.tree_at(lambda r: r.target_from_source, found, moved)


_run = eqx.filter_jit(align)


def _check_batches(sources, target):
    """Raise for sources that are no batch, and for another number of targets."""
    b, shape = sources.points.shape[0], target.points.shape
    if sources.points.ndim == 3 and (len(shape) == 2 or shape[0] == b):
        return
    raise GeometryError(
        message(
            "sources must be a batch [b, n, 3], and target one cloud or b of them",
            f"sources {tuple(sources.points.shape)}, target {tuple(shape)}",
            "Make batches with stack.",
        )
    )


@eqx.filter_jit
def _target_levels(targets, voxel_size, rooms, pyramid):
    """The levels of the one target of a batch."""
    one = jax.tree.map(lambda x: x[0], targets)
    return target_levels(one, voxel_size, rooms, pyramid)


@eqx.filter_jit
def _run_many(items, common, voxel_size, rooms, pyramid, chunk, mesh):
    arrays, static = eqx.partition(common, eqx.is_array)

    def run(items, given):
        common, voxel_size = eqx.combine(given[0], static), given[1]

        def one(item):
            source, target, start = item
            if target is None:
                return align_to(source, common, voxel_size, start, rooms, pyramid)
            return align(source, target, voxel_size, start, rooms, pyramid)

        return jax.lax.map(one, items, batch_size=chunk)

    return on_each(run, mesh)(items, (arrays, voxel_size))


def _checked(cloud, name) -> PointCloud:
    """The finite points of a cloud, on the host."""
    cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    finite = _masked(cloud).trim()
    if len(finite.points) < _FEWEST:
        raise GeometryError(
            message(
                f"the {name} must have at least {_FEWEST} finite points",
                f"{len(finite.points)} of {len(cloud.points)}",
                "Check the file, its units, or the mask of the cloud.",
            )
        )
    return finite


def _masked(cloud) -> PointCloud:
    """The cloud on the host, with points and normals that are not finite masked."""
    points = np.asarray(cloud.points)
    mask = np.asarray(cloud.mask) & np.isfinite(points).all(axis=-1)
    normals = cloud.normals
    if normals is not None:
        normals = np.asarray(normals)
        mask = mask & np.isfinite(normals).all(axis=-1)
    # A batch has no constructor: its fields are replaced.
    where = lambda c: (c.points, c.normals, c.mask, c.attributes)
    none = lambda x: x is None
    return eqx.tree_at(where, cloud, (points, normals, mask, {}), is_leaf=none)


def _rows(batches):
    """The points and masks of all items: of the sources, then of the targets."""
    for cloud in batches:
        yield from zip(np.asarray(cloud.points, np.float64), cloud.mask, strict=True)


def _mean(points):
    return points.mean(axis=0) if len(points) else np.zeros(3)


def _start(init, source, target, center):
    """The transform to start from, between points about the center."""
    if init is None:
        return Rigid(np.eye(3), np.zeros(3))
    if isinstance(init, MeanAligned):
        return Rigid(np.eye(3), target.mean(axis=0) - source.mean(axis=0))
    return _conjugated(_as(init, np.float64), center)


def _identities(b):
    return Rigid(np.broadcast_to(np.eye(3), (b, 3, 3)), np.zeros((b, 3)))


def _conjugated(transform, center):
    """The transforms in coordinates about `center`, batched or not."""
    linear, shift = _parts(transform)
    turned = np.einsum("...ij,...j->...i", linear, center)
    where = lambda t: t.translation
    return eqx.tree_at(where, transform, shift + turned - center)


def _parts(transform):
    if isinstance(transform, Affine):
        return transform.coefficients, transform.translation
    scale = transform.scale if isinstance(transform, Similarity) else np.ones(())
    return scale[..., None, None] * transform.rotation, transform.translation


def _as(transform, dtype):
    return jax.tree.map(lambda x: np.asarray(x).astype(dtype), transform)


def _padded(clouds, points):
    """Both clouds at the size of one bucket, so that similar pairs share a program."""
    dtype = jax.dtypes.canonicalize_dtype(clouds[0].points.dtype)
    size = bucket(max(len(p) for p in points))
    normals = all(cloud.normals is not None for cloud in clouds)
    pad = lambda x: np.pad(x.astype(dtype), ((0, size - len(x)), (0, 0)))
    return [
        PointCloud(
            jnp.asarray(pad(p)),
            jnp.asarray(pad(cloud.normals)) if normals else None,
            jnp.arange(size) < len(p),
        )
        for cloud, p in zip(clouds, points, strict=True)
    ]


def _same_size(batches, center):
    """Both batches about the centers, padded to one bucket."""
    dtype = jax.dtypes.canonicalize_dtype(batches[0].points.dtype)
    size = bucket(max(cloud.points.shape[1] for cloud in batches))
    normals = all(cloud.normals is not None for cloud in batches)
    where = lambda c: (c.points, c.normals, c.mask)
    out = []
    for cloud in batches:
        room = [(0, 0), (0, size - cloud.points.shape[1])]
        mask = np.pad(cloud.mask, room)
        wash = lambda x, mask=mask, room=room: jnp.asarray(
            np.where(mask[..., None], np.pad(x, [*room, (0, 0)]), 0).astype(dtype)
        )
        offset = center[: len(cloud.points), None]
        points = wash(np.asarray(cloud.points, np.float64) - offset)
        parts = (points, wash(cloud.normals) if normals else None, jnp.asarray(mask))
        out.append(eqx.tree_at(where, cloud, parts, is_leaf=lambda x: x is None))
    return out


def _raise_for(found):
    """Raise for a status that is not success, in words."""
    if found.result == RESULTS.successful:
        return
    raise GeometryError(
        message(
            "the alignment must end with success",
            f"{RESULTS[found.result]} ({int(found.num_matches)} pairs, "
            f"{100 * float(found.fitness):.0f} % of the source)",
            "Pass a better init or another voxel_size, or throw=False to look at it.",
        )
    )
