"""A random part of a cloud."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from .._core import GeometryError, message
from ._cloud import PointCloud


def subsample(cloud: PointCloud, num: int, *, key: Key[Array, ""]) -> PointCloud:
    """`num` different real points of the cloud, uniformly at random.

    Where there are fewer real points, all of them and padding. Every point gets a
    random number, and the `num` largest are kept, which gives each set of points the
    same chance; `num` is static and at most the size of the array.
    """
    n = cloud.mask.shape[0]
    if not 1 <= num <= n:
        raise GeometryError(
            message(
                "num must be at least 1 and at most the room for points",
                f"num {num} of {n}",
                "Pass a smaller num.",
            )
        )
    lot = jnp.where(cloud.mask, jax.random.uniform(key, (n,)), -1.0)
    _, rows = jax.lax.top_k(lot, num)
    return jax.tree.map(lambda x: jnp.asarray(x)[rows], cloud)
