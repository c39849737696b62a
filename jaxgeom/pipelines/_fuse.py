"""From several scans of one object, in frames of their own, to one watertight mesh."""

from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Key

from .._core import RESULTS, GeometryError, bucket, first_failure, message
from ..registration import MultiView, match_views, multiview, spanning_poses
from ..shapes import PointCloud
from ..transforms import Rigid
from ._frames import Frames, checked, oriented
from ._pyramid import occupied
from ._reconstruct import Reconstruction, reconstruct

# The side of a voxel as a share of the longest side of a scan, and of the features'.
_FINE, _COARSE = 1 / 160, 4.0


class Fusion(eqx.Module):
    """The scans moved together, and the surface through all of them.

    - `world_from_scan`: a batched `Rigid` in double precision, in the unit of the
      points; the world is the frame of the first scan.
    - `cloud`: all points and normals in the world.
    - `reconstruction`: of the cloud, with the mesh.
    - `views`: overlaps, matches and residual of the joint alignment (its poses and
      `rmse` are in the unit of the points too).
    - `result`: the first status that is not success.
    - `notes`: sentences on what was assumed.
    """

    world_from_scan: Rigid
    cloud: PointCloud
    reconstruction: Reconstruction
    views: MultiView
    result: RESULTS
    notes: tuple[str, ...] = eqx.field(static=True, default=())


def fuse(
    scans: Sequence[PointCloud],
    *,
    start: Rigid | None = None,
    viewpoints: Float[Array, "*b 3"] | None = None,
    voxel_size: float | None = None,
    key: Key[Array, ""] | None = None,
    throw: bool = True,
    **settings,
) -> Fusion:
    """One mesh from overlapping scans, without any given pose (host form).

    Every pair of scans is aligned from features, the best pairs place all scans, all
    poses are refined together, and the union of the scans goes into `reconstruct`.

    **Arguments:**

    - `scans`: at least two clouds in one unit, each in a frame of its own. Missing
      normals are estimated.
    - `start`: a batched `Rigid`, world_from_scan, to begin with instead of features.
    - `viewpoints`: [3] or [b, 3], the position of the scanner in the frame of each
      scan, toward which estimated normals are turned. Without it they are turned
      outward as those of a closed surface, which is less certain.
    - `voxel_size`: of the finest level, in the unit of the points; 1/160 of the median
      longest side of the scans by default.
    - `key`: of the random samples; the answer is a function of the data and the key.
    - `throw`: raise `GeometryError` where a scan finds no partner.
    - `settings`: those of `reconstruct`, such as `resolution` and `trim`.

    **Statuses:** those of `multiview` and `reconstruct`.
    """
    scans = [checked(scan, i) for i, scan in enumerate(scans)]
    if len(scans) < 2:
        raise GeometryError(
            message("fuse needs at least two scans", f"{len(scans)}", "Add scans.")
        )
    frames = Frames.of(scans)
    batch, notes = oriented(frames.to_unit(scans), frames.viewpoints(viewpoints))
    fine = _FINE if voxel_size is None else voxel_size / frames.scale
    key = jax.random.key(0) if key is None else key
    if start is None:
        poses = _rough(batch, fine, key)
        _raise_unplaced(poses.reached, throw)
        start = poses.world_from_scan
    else:
        start = frames.unit_poses(start)
    capacity = _num_voxels(batch, fine)
    views = _refine(batch, start, fine, capacity)
    if throw:
        _raise_unmatched(views)
    poses = frames.user_poses(views.world_from_scan)
    cloud = _union(scans, batch, poses)
    out = reconstruct(cloud, throw=throw, **settings)
    views = eqx.tree_at(
        lambda v: (v.world_from_scan, v.rmse), views, (poses, views.rmse * frames.scale)
    )
    result = first_failure(views.result, out.result)
    return Fusion(poses, cloud, out, views, result, notes + out.notes)


@eqx.filter_jit
def _rough(batch, fine, key):
    graph = match_views(batch, voxel_size=_COARSE * fine, key=key)
    return spanning_poses(graph, batch.points.shape[0])


@eqx.filter_jit
def _refine(batch, start, fine, capacity):
    return multiview(batch, start, voxel_size=fine, capacity=capacity)


def _num_voxels(batch, fine) -> int:
    """The most voxels of the finest level that one scan occupies, as a bucket."""
    rows = zip(np.asarray(batch.points), np.asarray(batch.mask), strict=True)
    return bucket(max(occupied(points[mask], fine) for points, mask in rows))


def _union(scans, batch, poses) -> PointCloud:
    """All scans in the world, in double precision."""
    turned = np.asarray(batch.normals, np.float64) @ np.swapaxes(poses.rotation, 1, 2)
    moved = [
        np.asarray(s.points, np.float64) @ r.T + t
        for s, r, t in zip(scans, poses.rotation, poses.translation, strict=True)
    ]
    normals = [n[: len(s.points)] for n, s in zip(turned, scans, strict=True)]
    shared = set.intersection(*(set(s.attributes) for s in scans))
    attributes = {k: np.concatenate([s.attributes[k] for s in scans]) for k in shared}
    dtype = np.result_type(*(s.points.dtype for s in scans))
    points = np.concatenate(moved).astype(dtype)
    return PointCloud(points, np.concatenate(normals), None, attributes)


def _raise_unplaced(reached, throw):
    reached = np.asarray(reached)
    if throw and not reached.all():
        raise GeometryError(
            message(
                "every scan must overlap another one",
                f"scan {', '.join(map(str, np.flatnonzero(~reached)))} has no partner",
                "Leave it out, give a start, or set voxel_size and viewpoints.",
            )
        )


def _raise_unmatched(views):
    alone = np.flatnonzero(np.asarray(views.num_matches) == 0)
    if alone.size:
        raise GeometryError(
            message(
                "every scan must match another one at the given start",
                f"scan {', '.join(map(str, alone))} matches none",
                "Check the start, or leave it out.",
            )
        )
