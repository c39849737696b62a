"""Nearest points for a source that moves: what one search says about the next ones.

Only those points are searched anew that the last search leaves in doubt: a point that
has moved by s is at least as far less s from every other target point as it was.

Source: M. Greenspan, G. Godin, A nearest neighbor method for efficient ICP, 2001.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import safe_norm
from ..neighbors import AbstractIndex, knn
from ..shapes import PointCloud

# How far beyond the gate points are searched.
_BEYOND = 1.1


class Memory(eqx.Module):
    """What a search for nearest points says about later ones.

    Where each source point was when it was searched, which target points were the
    nearest two (one past the last if all are too far), and how far every point but the
    first was at least.
    """

    points: Float[Array, "n 3"]
    nearest: Int[Array, "n 2"]
    apart: Float[Array, " n"]


def nearest_pairs(
    index: AbstractIndex, moved: PointCloud, max_distance, memory: Memory | None
) -> tuple[Memory, Bool[Array, " n"]]:
    """The memory after this search, and where the nearest point is within the gate.

    Successive points of `moved` must be near each other, as a scene sorts its source.
    """
    # Beyond the gate, so that points without a pair need not be searched at once.
    reach = _BEYOND * max_distance
    points = jax.lax.stop_gradient(moved.points)
    rows = jnp.arange(points.shape[0], dtype=jnp.int32)[None]
    search = lambda mask, limit: knn(
        index, points, 2, mask=mask, max_distance=limit, groups=rows
    )
    if memory is None:
        limit = reach
        near = search(moved.mask, limit)
    else:
        sure = _still_nearest(index, points, memory, max_distance)
        limit = jnp.minimum(reach, _beyond(index, points, memory))
        near = search(moved.mask & ~sure, limit)
    apart = jnp.minimum(near.distances[:, 1], limit)
    fresh = Memory(points, near.indices, apart)
    if memory is not None:
        keep = lambda new, old: jnp.where(
            sure.reshape(-1, *[1] * (new.ndim - 1)), old, new
        )
        fresh = jax.tree.map(keep, fresh, memory)
    distance = _distance_to(index, points, fresh.nearest[:, 0])
    return fresh, moved.mask & (distance <= max_distance)


def _still_nearest(index, points, memory, max_distance) -> Bool[Array, " n"]:
    """Where what was nearest at the last search must be so still."""
    step = safe_norm(points - memory.points)
    distance = _distance_to(index, points, memory.nearest[:, 0])
    # Without a nearest point it is enough that the others stay beyond the gate.
    distance = jnp.minimum(distance, max_distance)
    rounding = 32 * jnp.finfo(points.dtype).eps * jnp.max(jnp.abs(points))
    return distance + rounding < memory.apart - step


def _beyond(index, points, memory):
    """No farther than this are now two target points: those that were the nearest."""
    far = lambda i: _distance_to(index, points, memory.nearest[:, i])
    rounding = 1 + 8 * jnp.finfo(points.dtype).eps
    return rounding * jnp.maximum(far(0), far(1))


def _distance_to(index, points, nearest):
    """The distance to the nearest points; infinite where there is none."""
    there = jax.lax.stop_gradient(index.points)
    there = there.at[nearest].get(mode="fill", fill_value=jnp.inf)
    some = jnp.isfinite(there[:, 0])
    gap = jnp.where(some[:, None], points - there, 0)
    return jnp.where(some, safe_norm(gap), jnp.inf)
