"""Morton (Z-order) codes: sort by them and neighbors in space lie near in memory."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# 20 bits per axis, in two words of 30 bits: octree levels 1 to 10 and 11 to 20.
LEVELS = 20
_HALF = 10


def bounds(points: Float[Array, "n 3"], mask: Bool[Array, " n"]):
    """The bounding box of the real points; a point at the origin if there is none."""
    some = jnp.any(mask)
    low = jnp.min(jnp.where(mask[:, None], points, jnp.inf), axis=0)
    high = jnp.max(jnp.where(mask[:, None], points, -jnp.inf), axis=0)
    return jnp.where(some, low, 0), jnp.where(some, high, 0)


def codes(points: Float[Array, "n 3"], low, side):
    """The two words of the Morton code in the cube [low, low + side]^3."""
    unit = jnp.clip((points - low) / jnp.where(side > 0, side, 1), 0, 1)
    cell = jnp.minimum((unit * 2**LEVELS).astype(jnp.uint32), 2**LEVELS - 1)
    weave = lambda c: (
        (_spread(c[:, 0]) << 2) | (_spread(c[:, 1]) << 1) | _spread(c[:, 2])
    )
    return weave(cell >> _HALF), weave(cell & (2**_HALF - 1))


def morton_order(points, mask, low, high):
    """The permutation that sorts by code, padding last, and the sorted codes."""
    coarse, fine = codes(points, low, jnp.max(high - low))
    coarse = jnp.where(mask, coarse, jnp.uint32(2**31))
    index = jnp.arange(points.shape[0], dtype=jnp.int32)
    coarse, fine, order = jax.lax.sort((coarse, fine, index), num_keys=2)
    return order, coarse, fine


def curve(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Int[Array, " n"]:
    """The rows of the real points along a Morton curve through them, then the rest."""
    return morton_order(points, mask, *bounds(points, mask))[0]


def occupied_cells(coarse, fine, mask) -> Int[Array, " levels"]:
    """The number of octree cells that hold points, at levels 0 to 20.

    Arguments are sorted codes; `mask` is True for the leading, real ones.
    """
    new = lambda word, shift: (word[1:] >> shift) != (word[:-1] >> shift)
    top = [new(coarse, 30 - 3 * level) for level in range(_HALF + 1)]
    deep = [top[-1] | new(fine, 27 - 3 * level) for level in range(_HALF)]
    counts = [jnp.sum(change & mask[1:]) for change in top + deep]
    return jnp.stack(counts) + jnp.any(mask)


def _spread(x):
    """The low 10 bits of x, two zero bits between each."""
    x = (x | (x << 16)) & 0x030000FF
    x = (x | (x << 8)) & 0x0300F00F
    x = (x | (x << 4)) & 0x030C30C3
    return (x | (x << 2)) & 0x09249249
