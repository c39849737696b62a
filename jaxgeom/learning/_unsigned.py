"""Dense points of an unsigned field, whose surface has no sign to extract by."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from .._core import RESULTS, failure_where, safe_normalize
from ..shapes import Grid, PointCloud


class DensePoints(eqx.Module):
    """Points near the zero set of an unsigned field.

    `cloud`: `mask` is True where the field is at most the tolerance; there are
    `num_points` of them. `result`: `no_surface` where there is none.
    """

    cloud: PointCloud
    num_points: Int[Array, ""]
    result: RESULTS


def dense_points(
    field: Callable,
    grid: Grid,
    num: int,
    *,
    key: Key[Array, ""],
    tolerance: Float[Array, ""] | float,
    num_steps: int = 8,
    rounds: int = 2,
) -> DensePoints:
    """`num` points of the box of a grid pulled onto the surface of an unsigned field.

    x <- x - f(x) grad f / |grad f|, `num_steps` times. After each round but the last,
    points that did not arrive are replaced by arrived ones, and all are moved by normal
    deviates of a third of the reach before they are pulled again, which evens out the
    density. Pure; `num`, `num_steps`, `rounds` are static.

    **Arguments:** `tolerance`: a point has arrived where f(x) <= tolerance, in the unit
    of the points.

    **Statuses:** `no_surface`.

    Source: J. Chibane et al., Neural unsigned distance fields, 2020, algorithm 1.
    """
    key_start, key_rounds = jax.random.split(key)
    dtype = grid.origin.dtype
    cells = jnp.asarray(grid.shape, dtype) - 1
    share = jax.random.uniform(key_start, (num, 3), dtype)
    tolerance = jnp.asarray(tolerance, dtype)
    points = pull(field, grid.origin + share * cells * grid.spacing, num_steps)

    def again(points, key):
        key_pick, key_move = jax.random.split(key)
        near = jax.vmap(field)(points) <= tolerance
        rows = _rows_of(near, num, key_pick)
        step = jnp.max(grid.spacing) / 3
        moved = points[rows] + step * jax.random.normal(key_move, points.shape, dtype)
        return pull(field, moved, num_steps), None

    keys = jax.random.split(key_rounds, rounds - 1)
    points, _ = jax.lax.scan(again, points, keys)
    mask = jax.vmap(field)(points) <= tolerance
    count = jnp.sum(mask).astype(jnp.int32)
    cloud = PointCloud(points, None, mask).washed()
    return DensePoints(cloud, count, failure_where(count == 0, RESULTS.no_surface))


def pull(
    field: Callable, points: Float[Array, "n 3"], num_steps: int
) -> Float[Array, "n 3"]:
    """Points moved `num_steps` times by f along -grad f / |grad f|."""

    def step(x, _):
        value, slope = jax.vmap(jax.value_and_grad(field))(x)
        return x - value[:, None] * safe_normalize(slope), None

    return jax.lax.scan(step, points, length=num_steps)[0]


def _rows_of(near, num, key):
    """`num` random rows among the `near` ones (any, where there are none)."""
    rank = jnp.cumsum(near)
    count = rank[-1]
    wanted = jnp.floor(jax.random.uniform(key, (num,)) * count).astype(rank.dtype) + 1
    rows = jnp.searchsorted(rank, jnp.minimum(wanted, count))
    return jnp.where(count > 0, rows, jnp.arange(num))
