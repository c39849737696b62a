"""Many scans in, the motion that lays each on its target out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, bucket, message
from ..registration import Registration
from ..shapes import PointCloud
from ..transforms import Affine, Rigid, Similarity
from ._devices import gathered, on_each, placed
from ._pyramid import (
    Pyramid,
    TargetLevel,
    align,
    align_to,
    choose_voxel_size,
    level_rooms,
    target_levels,
    without_sparse_levels,
)
from ._register import as_dtype, conjugated, masked


class SharedTarget(eqx.Module):
    """A target with its levels and search structures, about its center, for any number
    of calls of `register_many`."""

    levels: tuple[TargetLevel, ...]
    center: Float[Array, " 3"]
    voxel_size: float = eqx.field(static=True)
    pyramid: Pyramid

    def rooms(self, scans) -> tuple[int | None, ...]:
        """The capacity of every level that holds the points [n, 3] of `scans`."""
        return level_rooms(scans, self.voxel_size, self.pyramid)


def share_target(
    target: PointCloud,
    *,
    voxel_size: float | None = None,
    pyramid: Pyramid | None = None,
) -> SharedTarget:
    """The target of many calls of `register_many`, prepared once (host form).

    `voxel_size` and `pyramid` are those of `register`. Raises `GeometryError` for a
    target without finite points.
    """
    pyramid = Pyramid() if pyramid is None else pyramid
    target = masked(target).trim()
    points = np.asarray(target.points, np.float64)
    if not len(points):
        raise GeometryError(
            message(
                "the target must have finite points",
                "none",
                "Check the file, its units, or the mask of the cloud.",
            )
        )
    if voxel_size is None:
        voxel_size = choose_voxel_size(points)
    pyramid = without_sparse_levels([points], voxel_size, pyramid)
    rooms = level_rooms([points], voxel_size, pyramid)
    return _shared(target, voxel_size, pyramid, rooms)


def register_many(
    sources: PointCloud,
    target: PointCloud | SharedTarget,
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
    - `target`: one cloud for all, or a batch [b, m, 3] with one for each, or what
      `share_target` made of one, with its own `voxel_size` and `pyramid`.
    - `init`: batched transforms; identity by default.
    - `rooms`: the capacity of every level, such as of `level_rooms`, so that batches
      of one size share one program; by default what this batch needs, without levels
      on which its scans are sparse.
    - `chunk`: how many each device aligns at once; memory grows with it. One at a
      time is fastest on a CPU.

    The batch is divided among all local devices. Every item has its own status; none
    is ever raised. Raises `GeometryError` where the shapes do not go together.
    """
    _check_batches(sources, target, voxel_size, pyramid)
    sources = masked(sources)
    if isinstance(target, SharedTarget):
        return _on_shared(sources, target, init, rooms, chunk)
    target = masked(target)
    pyramid = Pyramid() if pyramid is None else pyramid
    some = [points for points in (*_rows(sources), *_rows(target)) if len(points)]
    if voxel_size is None:
        voxel_size = float(np.median([choose_voxel_size(p) for p in some] or [1.0]))
    if rooms is None:
        some = some or [np.zeros((1, 3))]
        pyramid = without_sparse_levels(some, voxel_size, pyramid)
        rooms = level_rooms(some, voxel_size, pyramid)
    if target.points.ndim == 2:
        shared = _shared(target, voxel_size, pyramid, rooms)
        return _on_shared(sources, shared, init, rooms, chunk)
    center = np.stack([_mean(points) for points in _rows(target)])
    clouds = _same_size((sources, target), center)
    return _run_many(clouds, center, None, init, rooms, chunk, voxel_size, pyramid)


def _check_batches(sources, target, voxel_size, pyramid):
    """Raise for sources that are no batch, and for what does not go with the target."""
    b = sources.points.shape[0]
    if isinstance(target, SharedTarget):
        if voxel_size is not None or pyramid is not None:
            raise GeometryError(
                message(
                    "a shared target has its own voxel_size and pyramid",
                    "another one",
                    "Pass them to share_target.",
                )
            )
        shape = ()
    else:
        shape = target.points.shape
    if sources.points.ndim == 3 and (len(shape) != 3 or shape[0] == b):
        return
    raise GeometryError(
        message(
            "sources must be a batch [b, n, 3], and target one cloud or b of them",
            f"sources {tuple(sources.points.shape)}, target {tuple(shape)}",
            "Make batches with stack.",
        )
    )


def _shared(target, voxel_size, pyramid, rooms) -> SharedTarget:
    """The levels of a masked target on the host, perhaps without points."""
    center = _mean(next(_rows(target)))
    (cloud,) = _same_size([_as_batch(target)], center[None])
    size = jnp.asarray(voxel_size, cloud.points.dtype)
    levels = _target_levels(cloud, size, rooms, pyramid)
    return SharedTarget(levels, center, float(voxel_size), pyramid)


@eqx.filter_jit
def _target_levels(batch, voxel_size, rooms, pyramid):
    one = jax.tree.map(lambda x: x[0], batch)
    return target_levels(one, voxel_size, rooms, pyramid)


def _on_shared(sources, shared, init, rooms, chunk) -> Registration:
    """The alignments of masked sources to one target."""
    if rooms is None:
        rooms = shared.rooms(
            [p for p in _rows(sources) if len(p)] or [np.zeros((1, 3))]
        )
    center = np.broadcast_to(shared.center, (len(sources.points), 3))
    clouds = (*_same_size([sources], center), None)
    sizes = (shared.voxel_size, shared.pyramid)
    return _run_many(clouds, center, shared.levels, init, rooms, chunk, *sizes)


def _run_many(clouds, center, levels, init, rooms, chunk, voxel_size, pyramid):
    """The alignments, in coordinates of the given clouds."""
    b, dtype = len(center), clouds[0].points.dtype
    start = _identities(b) if init is None else as_dtype(init, np.float64)
    start = as_dtype(conjugated(start, center), dtype)
    items, mesh = placed((*clouds, start))
    size = jnp.asarray(voxel_size, dtype)
    found = _compiled(items, levels, size, rooms, pyramid, chunk, mesh)
    found = found if mesh is None else gathered(found, b)
    moved = conjugated(as_dtype(found.target_from_source, np.float64), -center)
    return eqx.tree_at(lambda r: r.target_from_source, found, moved)


@eqx.filter_jit
def _compiled(items, levels, voxel_size, rooms, pyramid, chunk, mesh):
    arrays, static = eqx.partition(levels, eqx.is_array)

    def run(items, given):
        levels, voxel_size = eqx.combine(given[0], static), given[1]

        def one(item):
            source, target, start = item
            if target is None:
                return align_to(source, levels, voxel_size, start, rooms, pyramid)
            return align(source, target, voxel_size, start, rooms, pyramid)

        # A group of one would be a vmap, under which all branches are computed.
        return jax.lax.map(one, items, batch_size=chunk if chunk > 1 else None)

    return on_each(run, mesh)(items, (arrays, voxel_size))


def _rows(cloud):
    """The points of every item of a masked cloud, in double precision."""
    batch = _as_batch(cloud)
    for points, mask in zip(batch.points, batch.mask, strict=True):
        yield np.asarray(points, np.float64)[mask]


def _as_batch(cloud):
    """A cloud as a batch of one; a batch as it is."""
    return cloud if cloud.points.ndim == 3 else jax.tree.map(lambda x: x[None], cloud)


def _mean(points):
    return points.mean(axis=0) if len(points) else np.zeros(3)


def _identities(b):
    return Rigid(np.broadcast_to(np.eye(3), (b, 3, 3)), np.zeros((b, 3)))


def _same_size(batches, center):
    """Batches about the centers, padded to one bucket; normals where all have them."""
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
        points = wash(np.asarray(cloud.points, np.float64) - center[:, None])
        parts = (points, wash(cloud.normals) if normals else None, jnp.asarray(mask))
        out.append(eqx.tree_at(where, cloud, parts, is_leaf=lambda x: x is None))
    return out
