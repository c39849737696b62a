"""A virtual depth scanner."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from .._core import safe_norm
from ..shapes import PointCloud
from ._camera import Camera
from ._trace import sphere_trace


def scan(
    field: Callable,
    cameras: Sequence[Camera],
    *,
    rays: int = 128,
    noise=0.0,
    key: Key[Array, ""],
) -> PointCloud:
    """What depth cameras see of a field: n = len(cameras) * rays^2 points.

    Each camera sends rays x rays rays through a square picture, by sphere tracing. A
    hit point is moved along its ray by a normal deviate times `noise` (a length).
    Normals are the field's, towards the camera. Rays that miss are masked out, and are
    zero. The attribute `viewpoint` [n, 3] is where each point was seen from.

    A ray ends at twice the distance from camera to target.
    """
    keys = jax.random.split(key, len(cameras))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)
    view = lambda one: _view(field, one[0], rays, noise, one[1])
    views = jax.lax.map(view, (stacked, keys))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), views)


def _view(field, camera, rays, noise, key):
    directions = camera.directions((rays, rays)).reshape(-1, 3)
    far = 2 * safe_norm(camera.target - camera.position)
    trace = lambda d: sphere_trace(field, camera.position, d, max_distance=far)
    hits = jax.vmap(trace)(directions)
    error = noise * jax.random.normal(key, hits.distance.shape, directions.dtype)
    away = jnp.sum(hits.normal * directions, axis=-1, keepdims=True) > 0
    cloud = PointCloud(
        hits.point + error[:, None] * directions,
        jnp.where(away, -hits.normal, hits.normal),
        hits.hit,
        {"viewpoint": jnp.broadcast_to(camera.position, directions.shape)},
    )
    return cloud.washed()
