"""Points that cover a cloud evenly."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from .._core import GeometryError, message
from ..shapes import PointCloud


def farthest_points(
    cloud: PointCloud, num: int, *, start: Int[Array, ""] | int | None = None
) -> PointCloud:
    """`num` points, each the farthest from those before it.

    The first is number `start` of the array (the first real point by default). The
    largest distance of a real point to the chosen ones is at most twice that of the
    best choice. `num` is static and at most the size of the array; where there are
    fewer real points, the rest is padding. The choice is a constant under
    differentiation.

    Source: T. F. Gonzalez, Clustering to minimize the maximum intercluster distance,
    1985.
    """
    n = cloud.mask.shape[0]
    if not 1 <= num <= n:
        must = "num must be at least 1 and at most the room for points"
        raise GeometryError(message(must, f"num {num} of {n}", "Pass a smaller num."))
    points = jax.lax.stop_gradient(cloud.washed().points)
    mask = jnp.asarray(cloud.mask) & jnp.all(jnp.isfinite(points), axis=1)
    first = jnp.argmax(mask) if start is None else start

    def choose(carry, _):
        row, apart = carry
        square = jnp.sum((points - points[row]) ** 2, axis=1)
        # What was chosen is never chosen again, even where points coincide.
        apart = jnp.minimum(apart, square).at[row].set(-1)
        following = jnp.argmax(apart).astype(jnp.int32)
        return (following, apart), (row, following, apart[following] >= 0)

    room = jnp.where(mask, jnp.inf, -1).astype(points.dtype)
    begin = (jnp.asarray(first, jnp.int32), room)
    _, (rows, _, more) = jax.lax.scan(choose, begin, None, length=num)
    found = jnp.concatenate([mask[rows[:1]], more[:-1]])
    small = jax.tree.map(lambda x: jnp.asarray(x)[rows], cloud)
    return PointCloud(small.points, small.normals, found, small.attributes)
