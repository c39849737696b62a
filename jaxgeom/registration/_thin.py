"""One oriented point per voxel."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core import safe_divide, safe_normalize
from ..shapes import PointCloud


def thin(
    cloud: PointCloud, voxel_size: Float[Array, ""] | float, capacity: int
) -> tuple[PointCloud, Int[Array, ""]]:
    """The mean point and normal of every occupied voxel, and how many there are.

    `cloud` has normals. Voxels beyond the static `capacity` are left out; which voxel a
    point is in is a constant under differentiation.
    """
    points, normals = jnp.asarray(cloud.points), jnp.asarray(cloud.normals)
    finite = jnp.all(jnp.isfinite(points) & jnp.isfinite(normals), axis=1)
    mask = cloud.mask & finite
    low = jnp.min(jnp.where(mask[:, None], points, jnp.inf), axis=0)
    low = jnp.where(jnp.isfinite(low), low, 0)
    offset = jnp.where(mask[:, None], points - low, 0)
    cell = jnp.floor(jax.lax.stop_gradient(offset) / voxel_size).astype(jnp.int32)
    last = jnp.iinfo(jnp.int32).max
    columns = [jnp.where(mask, cell[:, d], last) for d in range(3)]
    number = jnp.arange(mask.shape[0], dtype=jnp.int32)
    *columns, order = jax.lax.sort((*columns, number), num_keys=3)
    new = jnp.any(jnp.stack([jnp.diff(c, prepend=-1) != 0 for c in columns]), axis=0)
    new = new & mask[order]
    slot = jnp.where(mask[order], jnp.cumsum(new) - 1, capacity)
    rows = jnp.concatenate(
        [offset, jnp.where(mask[:, None], normals, 0), mask[:, None]], axis=1
    )
    total = (
        jnp.zeros((capacity, 7), points.dtype).at[slot].add(rows[order], mode="drop")
    )
    real = jnp.arange(capacity) < jnp.sum(new)
    mean = low + safe_divide(total[:, :3], total[:, 6:])
    mean = jnp.where(real[:, None], mean, 0)
    return PointCloud(mean, safe_normalize(total[:, 3:6]), real), jnp.sum(new)
