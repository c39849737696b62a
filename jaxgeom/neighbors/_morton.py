"""Morton (Z-order) codes: sort by them and neighbors in space lie near in memory.

Unlike that of `kd_groups`, the order of the real points does not depend on padding.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# 20 bits per axis, in two words of 30 bits.
_LEVELS, _HALF = 20, 10


def bounds(points: Float[Array, "n 3"], mask: Bool[Array, " n"]):
    """The bounding box of the real points; a point at the origin if there is none."""
    some = jnp.any(mask)
    low = jnp.min(jnp.where(mask[:, None], points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(mask[:, None], points, -jnp.inf), axis=0)
    return jnp.where(some, low, 0), jnp.where(some, high, 0)


def codes(points: Float[Array, "n 3"], low, side):
    """The two words of the Morton code in the cube [low, low + side]^3."""
    unit = jnp.clip((points - low) / jnp.where(side > 0, side, 1), 0, 1)
    cell = jnp.minimum((unit * 2**_LEVELS).astype(jnp.uint32), 2**_LEVELS - 1)
    weave = lambda c: (
        (_spread(c[:, 0]) << 2) | (_spread(c[:, 1]) << 1) | _spread(c[:, 2])
    )
    return weave(cell >> _HALF), weave(cell & (2**_HALF - 1))


def morton_order(points, mask, low, high) -> Int[Array, " n"]:
    """The permutation that sorts by code, padding last."""
    coarse, fine = codes(points, low, jnp.max(high - low))
    coarse = jnp.where(mask, coarse, jnp.uint32(2**31))
    index = jnp.arange(points.shape[0], dtype=jnp.int32)
    return jax.lax.sort((coarse, fine, index), num_keys=2)[2]


def _spread(x):
    """The low 10 bits of x, two zero bits between each."""
    x = (x | (x << 16)) & 0x030000FF
    x = (x | (x << 8)) & 0x0300F00F
    x = (x | (x << 4)) & 0x030C30C3
    return (x | (x << 2)) & 0x09249249
