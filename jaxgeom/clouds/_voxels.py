"""One point per voxel."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core import RESULTS, failure_where, safe_divide, safe_normalize
from ..shapes import PointCloud


class VoxelSample(eqx.Module):
    """A cloud with one point per occupied voxel.

    `required_points` is how many voxels are occupied, whatever the capacity; `result`
    is `capacity_exceeded` where they do not fit.
    """

    cloud: PointCloud
    required_points: Int[Array, ""]
    result: RESULTS


def voxel_downsample(
    cloud: PointCloud,
    voxel_size: Float[Array, ""] | float,
    *,
    capacity: int | None = None,
    origin: Float[Array, " 3"] | None = None,
) -> VoxelSample:
    """The mean of the points, normals and attributes in every occupied voxel.

    Voxels are cubes of side `voxel_size` (in the unit of the points, positive), one of
    them with its lowest corner at `origin` (that of the bounding box by default).
    Means of normals are scaled to unit length, attributes must be numbers. `capacity`
    is the static room for voxels, the size of the cloud by default. Which voxel a point
    is in is a constant under differentiation; points and normals that are not finite
    are left out.
    """
    capacity = cloud.mask.shape[0] if capacity is None else capacity
    small, required = thin(cloud, voxel_size, capacity, origin=origin)
    result = failure_where(required > capacity, RESULTS.capacity_exceeded)
    return VoxelSample(small, required, result)


def thin(
    cloud: PointCloud,
    voxel_size: Float[Array, ""] | float,
    capacity: int,
    *,
    origin: Float[Array, " 3"] | None = None,
) -> tuple[PointCloud, Int[Array, ""]]:
    """The mean point and normal of every occupied voxel, and how many there are.

    `voxel_downsample` without its status: voxels beyond `capacity` are left out.
    """
    points = jnp.asarray(cloud.points)
    mask = cloud.mask & jnp.all(jnp.isfinite(points), axis=1)
    if cloud.normals is not None:
        mask = mask & jnp.all(jnp.isfinite(jnp.asarray(cloud.normals)), axis=1)
    low = jnp.min(jnp.where(mask[:, None], points, jnp.inf), axis=0)
    low = jnp.where(jnp.isfinite(low), low, 0)
    corner = low if origin is None else jnp.asarray(origin, points.dtype)
    # Means of offsets keep their digits far from the origin.
    offset = jnp.where(mask[:, None], points - low, 0)
    place = jax.lax.stop_gradient(jnp.where(mask[:, None], points - corner, 0))
    slot, order, required = _slots(place / voxel_size, mask, capacity)
    extra = {} if cloud.normals is None else {"": cloud.normals}
    carried = {name: jnp.asarray(x) for name, x in (cloud.attributes | extra).items()}
    flat = lambda x: x.reshape(x.shape[0], -1).astype(points.dtype)
    parts = [offset, mask[:, None].astype(points.dtype), *map(flat, carried.values())]
    rows = jnp.concatenate(parts, axis=1)
    rows = jnp.where(mask[:, None], rows, 0)[order]
    total = jnp.zeros((capacity, rows.shape[1]), points.dtype)
    # One scatter for all that is carried.
    total = total.at[slot].add(rows, mode="drop")
    mean = safe_divide(total, total[:, 3:4])
    real = jnp.arange(capacity) < required
    middle = jnp.where(real[:, None], low + mean[:, :3], 0)
    attributes, at = {}, 4
    for name, x in carried.items():
        width = math.prod(x.shape[1:])
        attributes[name] = mean[:, at : at + width].reshape(capacity, *x.shape[1:])
        at += width
    normals = None if cloud.normals is None else safe_normalize(attributes.pop(""))
    return PointCloud(middle, normals, real, attributes), required


def _slots(place, mask, capacity):
    """The voxel of each point in sorted order, that order, and how many voxels."""
    last = jnp.iinfo(jnp.int32).max
    cell = jnp.floor(place).astype(jnp.int32)
    columns = [jnp.where(mask, cell[:, d], last) for d in range(3)]
    number = jnp.arange(mask.shape[0], dtype=jnp.int32)
    *columns, order = jax.lax.sort((*columns, number), num_keys=3)
    differs = jnp.stack([c[1:] != c[:-1] for c in columns])
    new = jnp.pad(jnp.any(differs, axis=0), (1, 0), constant_values=True)
    new = new & mask[order]
    slot = jnp.where(mask[order], jnp.cumsum(new) - 1, capacity)
    return slot, order, jnp.sum(new)
