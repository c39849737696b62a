"""What an index of points promises, whatever finds the neighbors."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


class AbstractIndex(eqx.Module):
    """Points prepared for repeated searches.

    `points` are those given (gradients flow through them), `mask` is True for those
    that may be found, `groups` are these in groups that lie together, and near the next
    one (n for padding), if they are known.
    """

    points: eqx.AbstractVar[Float[Array, "n 3"]]
    mask: eqx.AbstractVar[Bool[Array, " n"]]
    groups: eqx.AbstractVar[Int[Array, "g s"] | None]

    @abstractmethod
    def search(
        self,
        queries: Float[Array, "q 3"],
        active: Bool[Array, " q"],
        k: int,
        reach: Float[Array, " q"],
        groups: Int[Array, "g s"] | None,
    ) -> Int[Array, "q k"]:
        """The k nearest points, nearest first, with squared distance up to `reach`.

        Missing ones are n. Rows that are not `active` may hold anything. `groups`
        are the queries in groups that lie together (q for padding), or None.
        """


class AbstractBackend(eqx.Module):
    """The choice of a search structure."""

    @abstractmethod
    def build(
        self, points: Float[Array, "n 3"], mask: Bool[Array, " n"]
    ) -> AbstractIndex:
        """The index of the points where `mask`."""


def usable(points, mask):
    """The points that are real and finite, and their coordinates washed."""
    # Which points are neighbors is piecewise constant: it has no gradient.
    points = jax.lax.stop_gradient(points)
    mask = mask & jnp.all(jnp.isfinite(points), axis=-1)
    return jnp.where(mask[:, None], points, 0), mask


def in_tiles(function, rows, size: int):
    """`function` over tiles of `size` rows of every array of `rows`, one at a time."""
    count = jax.tree.leaves(rows)[0].shape[0]
    size = max(1, min(size, count))
    tiles = -(-count // size)
    if tiles == 1:
        return function(rows)
    fold = lambda x: jnp.pad(
        x, [(0, tiles * size - count)] + [(0, 0)] * (x.ndim - 1), mode="edge"
    ).reshape(tiles, size, *x.shape[1:])
    out = jax.lax.map(function, jax.tree.map(fold, rows))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], out)
