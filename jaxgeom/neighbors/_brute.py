"""All distances, in tiles: for small sets, and for large ones on a GPU."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._backends import AbstractBackend, AbstractIndex, in_tiles, usable


class BruteIndex(AbstractIndex):
    """Points that are all compared with every query."""

    points: Float[Array, "n 3"]
    mask: Bool[Array, " n"]
    tile: int = eqx.field(static=True)
    groups: None = None

    @eqx.filter_jit
    def search(self, queries, active, k, reach, groups):
        points, mask = usable(self.points, self.mask)
        n = points.shape[0]
        return in_tiles(
            lambda rows: _nearest(*rows, points, mask, k, n),
            (queries, reach),
            self.tile,
        )


class BruteForce(AbstractBackend):
    """Compare every query with every point, `tile` queries at a time (O(n q) time)."""

    tile: int = eqx.field(static=True, default=256)

    def build(self, points, mask):
        return BruteIndex(points, mask, self.tile)


def _nearest(queries, reach, points, mask, k, n):
    # Differences, not |q|^2 + |p|^2 - 2 q.p, which rounds to wrong neighbors.
    square = sum((queries[:, d, None] - points[:, d]) ** 2 for d in range(3))
    square = jnp.where(mask, square, jnp.inf)
    negative, index = jax.lax.top_k(-square, min(k, n))
    index = jnp.where((-negative <= reach[:, None]) & (negative > -jnp.inf), index, n)
    return jnp.pad(index, ((0, 0), (0, k - min(k, n))), constant_values=n)
