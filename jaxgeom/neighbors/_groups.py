"""Groups of points that lie together: the leaves of a balanced k-d tree.

Every part is sorted along its widest side and cut into four equal ones, again and
again, all parts of a level at once. One integer holds the coordinate, rounded to what
room there is, and below it the place in the part: a CPU sorts single integers several
times faster than keys that carry something. Cuts need not be exact, for whoever uses
the groups measures them.

Source: J. L. Bentley, Multidimensional binary search trees used for associative
searching, 1975; sorting into tiles as S. Leutenegger et al., STR: a simple and
efficient algorithm for R-tree packing, 1997.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

_WAYS = 4
# Coordinates are rounded to no more bits than a single precision number has.
_BITS = 23


def kd_groups(
    points: Float[Array, "n d"], mask: Bool[Array, " n"], most: int
) -> Int[Array, "g s"]:
    """The rows of the points where `mask`, in 2^m groups of s <= `most` that lie
    together.

    Successive groups are siblings: 2, 4, 8, ... of them make the nodes of the tree.
    Missing rows are n and come last. Points must be finite.
    """
    n = points.shape[0]
    groups = 1 << (-(-n // most) - 1).bit_length()
    size = -(-n // groups)
    spare = groups * size - n
    sides = jnp.pad(points.T, ((0, 0), (0, spare)))
    real = jnp.pad(mask, (0, spare))
    rows = jnp.arange(groups * size, dtype=jnp.int32)
    parts = 1
    while parts < groups:
        place = _sorted_places(sides, real, parts)
        take = lambda x, place=place: x.at[..., place].get(mode="promise_in_bounds")
        sides, real, rows = take(sides), take(real), take(rows)
        parts = min(parts * _WAYS, groups)
    return jnp.where(real, rows, n).reshape(groups, size)


def _sorted_places(sides, real, parts) -> Int[Array, " m"]:
    """Where to take each entry from, to sort every part along its widest side."""
    sides, real = sides.reshape(len(sides), parts, -1), real.reshape(parts, -1)
    size = real.shape[1]
    low = jnp.min(jnp.where(real, sides, jnp.inf), axis=2, keepdims=True)
    high = jnp.max(jnp.where(real, sides, -jnp.inf), axis=2, keepdims=True)
    widest = jnp.argmax(high - low, axis=0)[None]
    pick = lambda x: jnp.take_along_axis(x, widest, axis=0)[0]
    along, least, width = pick(sides), pick(low), pick(high - low)
    room = max(1, (size - 1).bit_length())
    most = 2 ** min(_BITS, 32 - room) - 1
    share = (along - least) / jnp.where(width > 0, width, 1)
    # Padding goes last.
    level = jnp.where(real, jnp.clip(share, 0, 1) * (most - 1), most)
    index = jnp.arange(size, dtype=jnp.uint32)
    keys = jax.lax.sort((level.astype(jnp.uint32) << room) | index, dimension=1)
    start = jnp.arange(parts, dtype=jnp.int32)[:, None] * size
    return ((keys & (2**room - 1)).astype(jnp.int32) + start).reshape(-1)
