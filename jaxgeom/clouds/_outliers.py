"""Points that stand apart, as masks."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import GeometryError, message
from ..neighbors import AbstractBackend, build, knn
from ..shapes import PointCloud
from ._neighborhoods import nearest_graph


def keep(cloud: PointCloud, mask: Bool[Array, " n"]) -> PointCloud:
    """The cloud with only those of its real points where `mask` [n] is True."""
    return eqx.tree_at(lambda c: c.mask, cloud, cloud.mask & mask)


def statistical_inliers(
    cloud: PointCloud,
    *,
    k: int = 16,
    ratio: float = 2.0,
    backend: AbstractBackend | None = None,
) -> Bool[Array, " n"]:
    """Where the mean distance to k neighbors is below mean + `ratio` deviations.

    Mean and standard deviation (n - 1) of these mean distances over all real points;
    a point that coincides with all its k neighbors is no inlier. False for padding and
    for points with fewer neighbors. Use with `keep`.

    Source: R. B. Rusu et al., Towards 3D point cloud based object maps, 2008.
    """
    _check_k(k)
    near = nearest_graph(cloud, k + 1, backend=backend)
    real = near.mask[:, k]
    apart = jnp.sum(jnp.where(near.mask, near.distances, 0), axis=1) / k
    count = jnp.sum(real)
    mean = jnp.sum(jnp.where(real, apart, 0)) / jnp.maximum(count, 1)
    square = jnp.sum(jnp.where(real, (apart - mean) ** 2, 0))
    spread = jnp.sqrt(square / jnp.maximum(count - 1, 1))
    return real & (apart > 0) & (apart < mean + ratio * spread)


def radius_inliers(
    cloud: PointCloud,
    radius: Float[Array, ""] | float,
    *,
    least: int,
    backend: AbstractBackend | None = None,
) -> Bool[Array, " n"]:
    """Where at least `least` other points lie within `radius`.

    False for padding. `least` is static. Use with `keep`.
    """
    _check_k(least)
    points = cloud.washed().points
    index = build(points, cloud.mask, backend=backend)
    near = knn(
        *(index, points, least + 1),
        mask=cloud.mask,
        max_distance=radius,
        groups=index.groups,
    )
    return near.mask[:, least]


def _check_k(k):
    if k < 1:
        must = "the number of neighbors must be at least 1"
        raise GeometryError(message(must, f"{k}", "Pass 1 or more."))
