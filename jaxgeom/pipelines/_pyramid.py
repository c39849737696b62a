"""Coarse to fine: thinned clouds with normals, and how far pairs may be apart."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core import RESULTS, bucket, failure_where, first_failure
from ..clouds import thin
from ..normals import estimate
from ..registration import (
    Method,
    PreparedTarget,
    Registration,
    icp,
    prepare_target,
)
from ..shapes import PointCloud

# Single precision may put a few points on the far side of the border of a voxel.
_SLACK = 32
# A level with fewer points than this says more of its voxels than of the surface.
_SPARSE = 64


class Pyramid(eqx.Module):
    """The levels of an alignment, coarse first.

    Level i thins both clouds to one point per voxel of side `voxels[i]` times the voxel
    size (0: all points), and pairs points up to `gates[i]` voxel sizes apart. Levels
    that only start the next one end at steps below `coarse_rtol` (the `rtol` of `icp`).
    Normals that are needed and not given are estimated on each level from `neighbors`
    points.
    """

    voxels: tuple[float, ...] = eqx.field(static=True, default=(4.0, 2.0, 0.5))
    gates: tuple[float, ...] = eqx.field(static=True, default=(30.0, 10.0, 4.0))
    neighbors: int = eqx.field(static=True, default=12)
    method: Method = Method()
    max_steps: int = eqx.field(static=True, default=50)
    coarse_rtol: float = eqx.field(static=True, default=1e-3)


def _thinned(cloud: PointCloud, side, room: int | None):
    """One point per voxel, and how many there are."""
    return (cloud, jnp.zeros((), int)) if room is None else thin(cloud, side, room)


def _oriented(cloud: PointCloud, pyramid: Pyramid) -> PointCloud:
    """A source with normals, if they are needed."""
    if cloud.normals is not None or "source" not in pyramid.method.normals_of:
        return cloud
    return estimate(cloud, k=pyramid.neighbors)


def _prepared(cloud: PointCloud, pyramid: Pyramid) -> PreparedTarget:
    """The cloud as a target; its normals, if they are needed, by the same index."""
    target = prepare_target(cloud, pyramid.method.correspondence)
    if cloud.normals is not None or "target" not in pyramid.method.normals_of:
        return target
    found = estimate(target.cloud, k=pyramid.neighbors, index=target.index)
    return target.with_normals(found.normals)


def align(
    source: PointCloud,
    target: PointCloud,
    voxel_size: Float[Array, ""],
    init,
    rooms: tuple[int | None, ...],
    pyramid: Pyramid,
) -> Registration:
    """The alignment of the levels, each started from the one before.

    Both clouds have the same size; `rooms` is the capacity of every level, or None.
    """
    pair = jax.tree.map(lambda a, b: jnp.stack([a, b]), source, target)

    def level(i, side):
        # Both clouds in one loop: the program of a level is compiled once.
        small, need = jax.lax.map(partial(_thinned, side=side, room=rooms[i]), pair)
        if "source" in pyramid.method.normals_of:
            small = jax.lax.map(lambda c: _oriented(c, pyramid), small)
        source, target = (jax.tree.map(lambda x, j=j: x[j], small) for j in (0, 1))
        target = _prepared(target, pyramid)
        return source, target, _overflows(jnp.max(need), rooms[i])

    return _descend(level, voxel_size, init, rooms, pyramid)


class TargetLevel(eqx.Module):
    """A level of a target that many scans share, and whether its voxels did not fit."""

    target: PreparedTarget
    overflow: Bool[Array, ""]


def target_levels(
    target: PointCloud,
    voxel_size: Float[Array, ""],
    rooms: tuple[int | None, ...],
    pyramid: Pyramid,
) -> tuple[TargetLevel, ...]:
    """The levels of a target, coarse first, each prepared by the rule of pairs."""
    out = []
    for room, share in zip(rooms, pyramid.voxels, strict=True):
        small, need = _thinned(target, share * voxel_size, room)
        small = _prepared(small, pyramid)
        out.append(TargetLevel(small, _overflows(need, room)))
    return tuple(out)


def align_to(
    source: PointCloud,
    levels: tuple[TargetLevel, ...],
    voxel_size: Float[Array, ""],
    init,
    rooms: tuple[int | None, ...],
    pyramid: Pyramid,
) -> Registration:
    """As `align`, on the levels of a target that were made before."""

    def level(i, side):
        small, need = _thinned(source, side, rooms[i])
        full = levels[i].overflow | _overflows(need, rooms[i])
        return _oriented(small, pyramid), levels[i].target, full

    return _descend(level, voxel_size, init, rooms, pyramid)


def _descend(level, voxel_size, init, rooms, pyramid) -> Registration:
    """Down the levels; `level(i, side)` gives source, target, and if room lacks."""
    steps, overflow = jnp.zeros((), jnp.int32), jnp.asarray(False)
    for i in range(len(rooms)):
        side = _after(pyramid.voxels[i] * voxel_size, steps)
        source, target, full = level(i, side)
        overflow = overflow | full
        found = icp(
            *(source, target),
            init=init,
            method=pyramid.method,
            max_distance=pyramid.gates[i] * voxel_size,
            rtol=None if i == len(rooms) - 1 else pyramid.coarse_rtol,
            max_steps=pyramid.max_steps,
        )
        init, steps = found.target_from_source, steps + found.num_steps
    result = first_failure(
        failure_where(overflow, RESULTS.capacity_exceeded), found.result
    )
    where = lambda r: (r.num_steps, r.result)
    return eqx.tree_at(where, found, (steps, result))


def _overflows(need, room):
    """Whether more voxels hold points than there is room for; None is always enough."""
    return jnp.asarray(False) if room is None else need > room


def _after(value, steps):
    """`value`, but only once `steps` (never negative) is known.

    Otherwise a CPU may prepare a level while the one before still runs, which gains
    nothing on few cores, and such programs were seen to stall.
    """
    return jnp.where(steps < 0, jnp.nan, value)


def occupied(points: Float[Array, "n 3"], side: float) -> int:
    """The number of voxels of a given side that hold points (host)."""
    columns = np.ascontiguousarray(points.T)
    low = columns.min(axis=1, keepdims=True)
    x, y, z = np.floor((columns - low) / side).astype(np.int64)
    key = np.sort((x * (y.max() + 1) + y) * (z.max() + 1) + z)
    return 1 + int(np.count_nonzero(np.diff(key)))


def without_sparse_levels(clouds, voxel_size: float, pyramid: Pyramid) -> Pyramid:
    """The pyramid without coarse levels on which half of the clouds have few voxels.

    The finest level always stays (host).
    """

    def dense(share):
        counts = [occupied(points, share * voxel_size) for points in clouds]
        return np.median(counts) >= _SPARSE

    last = len(pyramid.voxels) - 1
    kept = [i for i, v in enumerate(pyramid.voxels) if i == last or not v or dense(v)]
    pick = lambda values: tuple(values[i] for i in kept)
    return dataclasses.replace(
        pyramid, voxels=pick(pyramid.voxels), gates=pick(pyramid.gates)
    )


def level_rooms(clouds, voxel_size: float, pyramid: Pyramid) -> tuple[int | None, ...]:
    """The capacity of every level for all given arrays of points (host)."""
    need = lambda points, side: min(len(points), occupied(points, side) + _SLACK)
    return tuple(
        bucket(max(need(points, share * voxel_size) for points in clouds))
        if share
        else None
        for share in pyramid.voxels
    )


def choose_voxel_size(points, per_voxel: float = 2.0) -> float:
    """The voxel side at which a voxel with points holds `per_voxel` on average (host).

    On a surface the number of voxels grows with the inverse square of the side.
    """
    wanted = max(len(points) / per_voxel, 1)
    side = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0))) / 32
    for _ in range(4):
        side = side * float(np.sqrt(occupied(points, side) / wanted))
    return side
