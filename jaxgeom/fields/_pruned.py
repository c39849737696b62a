"""A field on a whole grid, evaluated near its surface only."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core import RESULTS
from ..shapes import Grid
from ._bricks import BRICK, NODES
from ._narrow_band import NarrowBand, narrow_band


class PrunedSamples(eqx.Module):
    """Samples that are exact near the surface, and have the right sign elsewhere.

    `required_bricks`, `result`: as of `NarrowBand`.
    """

    values: Float[Array, "x y z"]
    required_bricks: Int[Array, ""]
    result: RESULTS


def sample_near_surface(
    field: Callable,
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    capacity: int,
    lipschitz: Float[Array, ""] | float | None = None,
    width: Float[Array, ""] | float = 0.0,
    chunk: int = 65536,
) -> PrunedSamples:
    """The values of a field at all nodes of a grid, exact in a narrow band.

    Elsewhere nodes get the value at the center of their brick of 8^3 cells, which is on
    the same side of the surface. Arguments and errors as of `narrow_band`; with a
    `width` of two cells central differences on the surface are exact, too.

    **Statuses:** `capacity_exceeded`, where samples near the surface are wrong;
    `no_surface`.
    """
    settings = {"lipschitz": lipschitz, "width": width, "chunk": chunk}
    band = narrow_band(field, grid, level, capacity=capacity, **settings)
    counts = [-(-n // BRICK) for n in grid.shape]
    bricks = jnp.stack(jnp.meshgrid(*map(jnp.arange, counts), indexing="ij"), axis=-1)
    center = lambda b: grid.origin + grid.spacing * (BRICK * (b + 0.5))
    rough = jax.lax.map(jax.vmap(jax.vmap(lambda b: field(center(b)))), bricks)
    for axis in range(3):
        rough = jnp.repeat(rough, BRICK, axis=axis)
    x, y, z = grid.shape
    values = _written(rough[:x, :y, :z], band, jnp.asarray(level, rough.dtype))
    return PrunedSamples(values, band.required_bricks, band.result)


def _written(values, band: NarrowBand, level):
    """The values, and those of the band at its nodes."""
    offsets = np.stack(np.indices((NODES,) * 3), axis=-1)
    nodes = BRICK * band.bricks[:, None, None, None] + offsets
    # Padding is written beyond the grid, where it is dropped.
    beyond = jnp.asarray(values.shape)
    nodes = jnp.where(band.mask()[:, None, None, None, None], nodes, beyond)
    i, j, k = jnp.moveaxis(nodes, -1, 0)
    return values.at[i, j, k].set(band.values + level, mode="drop")
