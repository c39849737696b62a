"""A field on a whole grid, evaluated near its surface only."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core import RESULTS, GeometryError, failure_where, message
from ..shapes import Grid
from ._field import claims

_SIDE = 8


class PrunedSamples(eqx.Module):
    """Samples that are exact near the surface, and have the right sign elsewhere.

    `required_blocks` is the capacity that was needed; `result` is `capacity_exceeded`
    where it was larger than given: then samples near the surface are wrong.
    """

    values: Float[Array, "x y z"]
    required_blocks: Int[Array, ""]
    result: RESULTS


def sample_near_surface(
    field: Callable,
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    capacity: int,
    lipschitz: Float[Array, ""] | float | None = None,
    width: Float[Array, ""] | float = 0.0,
    chunk: int = 128,
) -> PrunedSamples:
    """The values of a field at all nodes of a grid, block by block.

    Of every block of 8^3 nodes the center is evaluated. Where |f - level| there is more
    than L (r + `width`), r the radius of the block, no node is nearer than `width` to
    the surface, and all get the value of the center; the other blocks are evaluated at
    every node, `chunk` of them at a time.

    **Arguments:**

    - `capacity`: static; the number of blocks that may be evaluated. There are
      `required_blocks`, which one call tells.
    - `lipschitz`: L with |f(x) - f(y)| <= L |x - y|, by default what the field claims.
    - `width`: samples nearer to the surface than this length are exact: two cells for
      normals by central differences.

    **Statuses:** `capacity_exceeded`. Raises `GeometryError` where `lipschitz` is not
    given and the field makes no claim, or for a capacity below 1.
    """
    lipschitz = claims(field).lipschitz if lipschitz is None else lipschitz
    _check(lipschitz, capacity)
    counts = tuple(-(-n // _SIDE) for n in grid.shape)
    blocks = jnp.stack(
        jnp.meshgrid(*(_SIDE * jnp.arange(n) for n in counts), indexing="ij"), axis=-1
    ).reshape(-1, 3)
    place = lambda index: grid.origin + grid.spacing * index.astype(grid.origin.dtype)
    middle = (_SIDE - 1) / 2
    rough = jax.lax.map(lambda b: field(place(b + middle)), blocks, batch_size=4096)
    radius = middle * jnp.linalg.norm(grid.spacing)
    reach = lipschitz * (radius + width)
    # A value that is not a number tells nothing about its block.
    near = jax.lax.stop_gradient(~(jnp.abs(rough - level) > reach))
    rows = jnp.nonzero(near, size=capacity, fill_value=blocks.shape[0])[0]
    offsets = np.indices((_SIDE,) * 3).reshape(3, -1).T
    known = blocks.at[rows].get(mode="clip")
    block_of = lambda b: jax.vmap(lambda o: field(place(b + o)))(jnp.asarray(offsets))
    exact = jax.lax.map(block_of, known, batch_size=min(chunk, capacity))
    every = jnp.broadcast_to(rough[:, None], (blocks.shape[0], offsets.shape[0]))
    every = every.at[rows].set(exact, mode="drop")
    x, y, z = grid.shape
    values = every.reshape(*counts, *(_SIDE,) * 3).transpose(0, 3, 1, 4, 2, 5)
    values = values.reshape([_SIDE * n for n in counts])[:x, :y, :z]
    needed = jnp.sum(near, dtype=jnp.int32)
    short = failure_where(needed > capacity, RESULTS.capacity_exceeded)
    return PrunedSamples(values, needed, short)


def _check(lipschitz, capacity):
    if capacity < 1:
        must = "the capacity must be at least 1 block"
        raise GeometryError(message(must, f"{capacity}", "Pass a larger one."))
    known = not isinstance(lipschitz, jax.core.Tracer)
    if known and np.isnan(np.asarray(lipschitz)):
        raise GeometryError(
            message(
                "pruning needs a Lipschitz constant",
                "a field that claims none",
                "Pass lipschitz=, or `declare` the field; or use `sample`.",
            )
        )
