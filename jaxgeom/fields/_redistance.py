"""From any values on a grid to signed distances with the same surface."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import RESULTS, failure_where, first_failure, safe_norm, safe_normalize
from ..shapes import Grid
from ._sampled import Sampled


class Redistanced(eqx.Module):
    """Signed distances at the nodes of a grid, as made by `redistance`.

    - `values` [x, y, z]: in the unit of the points, with the signs of the input.
    - `closest` [x, y, z, 3]: the nearest point of the surface found for each node.
    """

    values: Float[Array, "x y z"]
    closest: Float[Array, "x y z 3"]
    result: RESULTS


class _Best(NamedTuple):
    """For each node a point near the surface, and distance plus what it is off by."""

    point: Array
    score: Array


def redistance(
    grid: Grid,
    values: Float[Array, "x y z"],
    *,
    rtol: float = 1e-3,
    max_steps: int = 64,
) -> Redistanced:
    """The signed distance to the zero set of the trilinear interpolant of `values`.

    Solves |grad d| = 1 with d = 0 where the interpolant is, by closest points rather
    than differences: the crossings of the grid's edges, which are exact, are handed
    from node to node (jump flooding, then neighbor to neighbor), and each node slides
    its point along the surface, y <- y + a (1 - n n^T)(x - y), and back onto it, as
    long as that brings it closer. Of second order in the spacing for smooth fields; at
    edges of a body, which the interpolant rounds off, of first.

    **Arguments:**

    - `values`: of any scale, negative inside; the scale may vary from place to place.
    - `rtol`: points lie on the surface to rtol times the spacing, and the search rests
      when no distance falls by more.

    **Statuses:** `no_surface` where all values have one sign (distances are then the
    diagonal of the grid); `not_converged` after `max_steps` rounds.

    Differentiable with respect to values, by the implicit function theorem at the
    closest points: dd = df / |grad f|.

    Source: Y. R. Tsai, Rapid and accurate computation of the distance function using
    grids, 2002 (closest points); G. Rong, T.-S. Tan, Jump flooding in GPU, 2006.
    """
    field = Sampled(grid, values)
    still = jax.lax.stop_gradient(field)
    nodes = jax.lax.stop_gradient(grid.nodes())
    seeds, some = _crossings(still, nodes)
    best, rested = _search(still, nodes, _flood(nodes, seeds), rtol, max_steps)
    y = best.point
    f, slope = _linearised(field, y)
    steep = jax.lax.stop_gradient(safe_norm(slope))
    moved = (f - jax.lax.stop_gradient(f)) / jnp.where(steep > 0, steep, 1)
    signed = jnp.sign(values) * safe_norm(nodes - y) + jnp.where(steep > 0, moved, 0)
    result = first_failure(
        failure_where(~some, RESULTS.no_surface),
        failure_where(~rested, RESULTS.not_converged),
    )
    return Redistanced(signed, y, result)


def _crossings(field, nodes):
    """The nearest zero on the edges at each node, and whether there is any."""
    values, spacing = field.values, field.grid.spacing
    extent = spacing * (jnp.asarray(values.shape) - 1)
    away = jnp.broadcast_to(safe_norm(extent) / 3**0.5, nodes.shape)
    best = jnp.where((values == 0)[..., None], nodes, nodes + away)
    known = values == 0
    for axis in range(3):
        for side in (-1, 1):
            other = _shifted(values, axis, side)
            cut = (values < 0) != (other < 0)
            t = jnp.where(cut, values, 0) / jnp.where(cut, values - other, 1)
            step = side * spacing[axis] * jnp.where(cut, t, 0)
            found = nodes.at[..., axis].add(step)
            closer = cut & (step**2 < jnp.sum((best - nodes) ** 2, axis=-1))
            best = jnp.where(closer[..., None], found, best)
            known = known | cut
    score = jnp.where(known, safe_norm(best - nodes), jnp.inf)
    return _Best(best, score), jnp.any(known)


def _flood(nodes, best):
    """Passes to neighbors n/2, n/4, ..., 1 away."""
    widest = max(nodes.shape[:3]) // 2
    count = widest.bit_length()
    reach = lambda i: jnp.maximum(widest >> i, 1)
    return jax.lax.fori_loop(0, count, lambda i, b: _pass(nodes, b, reach(i)), best)


def _pass(nodes, best, reach):
    """The best of each node's own point and those of the nodes `reach` away."""
    for axis in range(3):
        for side in (-1, 1):
            point = _shifted(best.point, axis, side * reach)
            # What the giver's point is off the surface by stays with the point.
            off = best.score - safe_norm(best.point - nodes)
            score = safe_norm(point - nodes) + _shifted(off, axis, side * reach)
            best = _better(best, _Best(point, score))
    return best


def _search(field, nodes, best, rtol, max_steps):
    rest = rtol * jnp.min(field.grid.spacing)

    def going(state):
        _, gain, steps = state
        return (gain > rest) & (steps < max_steps)

    def advance(state):
        best, _, steps = state
        new = _pass(nodes, best, 1)
        slide = lambda i, b: _better(b, _slide(field, nodes, b, 0.5**i, rest))
        new = jax.lax.fori_loop(0, 3, slide, new)
        return new, jnp.max(best.score - new.score), steps + 1

    start = (best, jnp.asarray(jnp.inf, nodes.dtype), jnp.int32(0))
    best, gain, _ = jax.lax.while_loop(going, advance, start)
    return best, gain <= rest


def _slide(field, nodes, best, amount, near):
    """Each point moved along its tangent plane towards its node, then projected.

    One that is not back on the surface is no candidate: |f| / |grad f| tells how far
    off it is only close by.
    """
    n = safe_normalize(_linearised(field, best.point)[1])
    gap = nodes - best.point
    along = gap - jnp.sum(gap * n, axis=-1, keepdims=True) * n
    y = _within(field.grid, best.point + amount * along)

    def newton(_, y):
        f, slope = _linearised(field, y)
        square = jnp.sum(slope**2, axis=-1)
        length = f / jnp.where(square > 0, square, 1)
        return _within(field.grid, y - length[..., None] * slope)

    y = jax.lax.fori_loop(0, 3, newton, y)
    f, slope = _linearised(field, y)
    steep = safe_norm(slope)
    off = jnp.abs(f) / jnp.where(steep > 0, steep, 1)
    off = jnp.where((steep > 0) & (off <= near), off, jnp.inf)
    return _Best(y, safe_norm(y - nodes) + off)


def _linearised(field, points):
    """Values [x, y, z] and gradients [x, y, z, 3]."""
    flat = jax.vmap(jax.value_and_grad(field))(points.reshape(-1, 3))
    return flat[0].reshape(points.shape[:3]), flat[1].reshape(points.shape)


def _within(grid, points):
    last = (jnp.asarray(grid.shape) - 1).astype(points.dtype)
    return jnp.clip(points, grid.origin, grid.origin + last * grid.spacing)


def _better(a, b):
    closer = b.score < a.score
    point = jnp.where(closer[..., None], b.point, a.point)
    return _Best(point, jnp.where(closer, b.score, a.score))


def _shifted(x, axis, reach):
    """The entries `reach` further along an axis; at the border, the last."""
    count = x.shape[axis]
    return jnp.take(x, jnp.clip(jnp.arange(count) + reach, 0, count - 1), axis=axis)
