"""Half-edges sorted so that those of one edge lie together."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


class EdgeRuns(eqx.Module):
    """The half-edges of a mesh, sorted by the (smaller, larger) vertex of their edge.

    `slots` [3f]: 3 * face + corner, where the half-edge starts; `low`, `high`, `apex`
    its smaller and larger end and the opposite vertex; `real` is False for those of
    padding and of faces that name a vertex twice, which come last. `joins[i]` tells
    that half-edge i has the same edge as half-edge i - 1.
    """

    slots: Int[Array, " e"]
    low: Int[Array, " e"]
    high: Int[Array, " e"]
    apex: Int[Array, " e"]
    real: Bool[Array, " e"]
    joins: Bool[Array, " e"]


def edge_runs(faces: Int[Array, "f 3"], proper: Bool[Array, " f"], v: int) -> EdgeRuns:
    """The sorted half-edges of the faces that are `proper`, in a mesh of v vertices."""
    start = faces.reshape(-1)
    end = jnp.roll(faces, -1, axis=1).reshape(-1)
    apex = jnp.roll(faces, -2, axis=1).reshape(-1)
    real = jnp.repeat(proper, 3, total_repeat_length=start.shape[0])
    low = jnp.where(real, jnp.minimum(start, end), v)
    slots = jnp.arange(start.shape[0], dtype=jnp.int32)
    low, high, apex, slots = jax.lax.sort(
        (low, jnp.maximum(start, end), apex, slots), num_keys=3
    )
    real = low < v
    same = (low[1:] == low[:-1]) & (high[1:] == high[:-1]) & real[1:]
    return EdgeRuns(slots, low, high, apex, real, jnp.pad(same, (1, 0)))
