"""Build an index once, ask it for the k nearest points as often as needed."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import (
    RESULTS,
    GeometryError,
    check_shape,
    failure_where,
    message,
    safe_norm,
)
from ._backends import AbstractBackend, AbstractIndex
from ._kd import KdTree


class Neighbors(eqx.Module):
    """The k nearest points of every query, nearest first.

    `mask` is True where there is such a neighbor; elsewhere `indices` are n (one past
    the last point) and `distances` infinite. `result` is `too_few_points` where there
    are fewer than k points in the index.
    """

    indices: Int[Array, "q k"]
    distances: Float[Array, "q k"]
    mask: Bool[Array, "q k"]
    result: RESULTS


def build(
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"] | None = None,
    *,
    backend: AbstractBackend | None = None,
) -> AbstractIndex:
    """The search structure of `points` [n, 3]; only those where `mask` are ever found.

    `backend` is `KdTree()` by default, `BruteForce()` for up to about a thousand
    points, `CandidateLists()` for the nearest one of a few thousand points that are
    searched very often, or `HostTree()`, scipy's k-d tree, for a CPU.
    Points that are not finite are never found. Raises `GeometryError` for wrong shapes.
    """
    check_shape("points", points, (None, 3))
    _check_some(points)
    mask = jnp.ones(points.shape[0], bool) if mask is None else jnp.asarray(mask)
    check_shape("mask", mask, (points.shape[0],))
    backend = KdTree() if backend is None else backend
    return backend.build(jnp.asarray(points), mask)


def knn(
    index: AbstractIndex,
    queries: Float[Array, "q 3"],
    k: int,
    *,
    mask: Bool[Array, " q"] | None = None,
    max_distance: Float[Array, "*q"] | float = jnp.inf,
    groups: Int[Array, "g s"] | None = None,
) -> Neighbors:
    """The exact k nearest points of every query: |q - p_1| <= |q - p_2| <= ...

    **Arguments:**

    - `queries`: [q, 3], in the unit of the points.
    - `k`: how many, a static int of at least 1.
    - `mask`: [q], False for padding among the queries, which finds nothing.
    - `max_distance`: farther points are not neighbors (a point at it is); one number,
      or one for each query.
    - `groups`: all rows of the queries, in groups that lie together, where they are
      known: `index.groups` for the points of the index, or those of `kd_groups`. That
      saves the time to find them; a row in no group finds nothing.

    Distances are differentiable in queries and points, with gradient zero where they
    are zero; the indices are constants. Raises `GeometryError` for wrong shapes or k.
    """
    check_shape("queries", queries, (None, 3))
    if k < 1:
        raise GeometryError(
            message("k must be at least 1", f"{k}", "Pass k=1 or more.")
        )
    queries = jnp.asarray(queries, index.points.dtype)
    n = index.points.shape[0]
    # Which points are nearest is piecewise constant: it has no gradient.
    fixed = jax.lax.stop_gradient(queries)
    active = jnp.all(jnp.isfinite(fixed), axis=-1)
    active = active if mask is None else active & mask
    gate = jax.lax.stop_gradient(jnp.asarray(max_distance, fixed.dtype))
    gate = jnp.broadcast_to(gate, active.shape)
    still = jax.lax.stop_gradient(index)
    clean = jnp.where(active[:, None], fixed, 0)
    reach = jnp.where(gate < 0, -1, gate * gate)
    indices = still.search(clean, active, k, reach, groups)
    indices = jnp.where(active[:, None], indices, n)
    found = indices < n
    there = index.points[jnp.where(found, indices, 0)]
    gap = jnp.where(found[..., None], queries[:, None] - there, 1)
    distances = jnp.where(found, safe_norm(gap), jnp.inf)
    few = jnp.sum(index.mask) < k
    result = failure_where(few, RESULTS.too_few_points)
    return Neighbors(indices.astype(jnp.int32), distances, found, result)


def _check_some(points):
    if points.shape[0] == 0:
        raise GeometryError(
            message(
                "an index needs room for at least one point",
                "0 points",
                "Pad the array and pass mask=False for the padding.",
            )
        )
