"""The nearest point of a parametric curve or surface."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from .._core import RESULTS, check_shape, failure_where, safe_norm
from ._abstract import AbstractCurve, AbstractSurface, floating
from ._box_newton import BoxNewton, is_free, model, newton_step
from ._search import Search


class ParametricPoint(eqx.Module):
    """The place of a curve or surface nearest to a query.

    - `parameters`: t [] of a curve, uv [2] of a surface.
    - `point` [3]: the place itself.
    - `distance`: |query - point|, in length.
    - `result`: `not_converged` where the difference is not normal to the shape.
    """

    parameters: Float[Array, "*d"]
    point: Float[Array, " 3"]
    distance: Float[Array, ""]
    result: RESULTS


def closest_point(
    shape: AbstractCurve | AbstractSurface,
    query: Float[Array, " 3"],
    *,
    starts: tuple[int, ...] | None = None,
    num_starts: int = 3,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int = 32,
) -> ParametricPoint:
    """The point of a curve or surface nearest to ONE query [3]; map with `jax.vmap`.

    The shape is evaluated on a grid of parameters; from the `num_starts` nearest of
    those nodes that are nearer than their neighbors, optimistix minimises
    |X(u, v) - p|^2, and the best end is returned. Ends of the domain are not passed,
    periodic parameters and poles are. The difference is then parallel to the normal,
    except at an end of the domain.

    **Arguments:**

    - `starts`: the cells of the grid, (c,) for a curve and (c, c) for a surface; by
      default 64 and (16, 16), and at least three for every piece between breaks. The
      nearest point is missed if the distance has features finer than this grid.
    - `solver`: any least-squares solver of optimistix; by default `BoxNewton`, which
      keeps to the domain. Others do not know of its ends: there the result may be
      `not_converged`.

    **Statuses:** `not_converged` after `max_steps`, or where the slope of the distance
    along the shape is more than rounding. So also at a corner or a crease inside the
    domain (a vertex of a polyline, a knot repeated as often as the degree): the point
    is found, but the difference is not normal there.

    Once differentiable in the query and in the parameters of the shape: `distance` by
    the envelope theorem, `parameters` and `point` by the implicit function theorem.
    The derivative of `distance` is zero on the shape itself, and those of `parameters`
    and `point` are zero in directions that have none, as around a pole.
    """
    query = floating(query)
    check_shape("query", query, (3,))
    search = Search.of(shape)
    frozen, held = search.frozen(), jax.lax.stop_gradient(query)
    begin = _begins(frozen, held, starts, num_starts)
    solver = _default_solver(query.dtype) if solver is None else solver
    ends = jax.vmap(lambda y: _descend(frozen, held, y, solver, max_steps))(begin)
    spans = jax.vmap(lambda y: safe_norm(frozen(y) - held))(ends)
    best = jax.lax.stop_gradient(frozen.wrap(ends[jnp.argmin(spans)]))
    return _located(search, frozen, query, best)


def _default_solver(dtype):
    root = float(jnp.finfo(dtype).eps) ** 0.5
    return BoxNewton(rtol=root, atol=root)


def _begins(search, query, starts, number):
    """The nearest local minima [number, d] of the distance on a grid of parameters."""
    usual = 64 if len(search.intervals) == 1 else 16
    cells = starts or [max(usual, 3 * len(i.pieces) - 3) for i in search.intervals]
    axes = [_nodes(i, c) for i, c in zip(search.intervals, cells, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    flat = jnp.asarray(grid.reshape(-1, len(axes)), query.dtype)
    square = jax.vmap(lambda y: jnp.sum((search(y) - query) ** 2))(flat)
    square = square.reshape(grid.shape[:-1])
    least = square
    for axis, interval in enumerate(search.intervals):
        least = jnp.minimum(least, _least_beside(square, axis, interval.periodic))
    # Where fewer are minima, the nearest other nodes serve.
    cost = jnp.where(square <= least, square, square + jnp.max(square))
    number = min(number, flat.shape[0])
    _, order = jax.lax.top_k(-cost.reshape(-1), number)
    return flat[order]


def _nodes(interval, cells):
    """Nodes of a start grid; the ends once, and no pole, where angles mean nothing."""
    nodes = interval.nodes(cells)
    if interval.periodic:
        return nodes[:-1]
    low, high = interval.poles
    nodes[0] += low * (nodes[1] - nodes[0]) / 2
    nodes[-1] -= high * (nodes[-1] - nodes[-2]) / 2
    return nodes


def _least_beside(values, axis, periodic):
    around = [jnp.roll(values, step, axis) for step in (1, -1)]
    if periodic:
        return jnp.minimum(*around)
    edges = [(1, 0) if other == axis else (0, 0) for other in range(values.ndim)]
    wide = jnp.pad(values, edges, mode="edge")
    below = jax.lax.slice_in_dim(wide, 0, values.shape[axis], axis=axis)
    last = jax.lax.slice_in_dim(values, -1, None, axis=axis)
    inner = jax.lax.slice_in_dim(values, 1, None, axis=axis)
    return jnp.minimum(below, jnp.concatenate([inner, last], axis))


def _descend(search, query, y, solver, max_steps):
    options = search.options(query, y)
    # In units of the largest length, so that tolerances mean the same at any size.
    unit = safe_norm(query) + safe_norm(search(y))
    unit = jnp.where(unit > 0, unit, 1)
    found = optx.least_squares(
        lambda x, given: (given[0](x) - given[1]) / given[2],
        solver,
        y,
        args=(search, query, unit),
        options=_in_unit(options, unit),
        max_steps=max_steps,
        throw=False,
    )
    return found.value


def _in_unit(options, unit):
    scaled = {k: options[k] / unit for k in ("rounding", "still")}
    return {**options, **scaled}


def _located(search: Callable, frozen, query, best) -> ParametricPoint:
    """One Newton step at the end found, and its derivatives: those of the solution."""
    held = jax.lax.stop_gradient(query)
    options = frozen.options(held, best)
    local = model(lambda x: frozen(x) - held, best)
    free = is_free(local.jacobian, local.slope, best, options)
    step = newton_step(local, local.slope, free)
    there = frozen.wrap(best + step)
    # The step is left out where it does harm: at a fold, or far from the solution.
    before, after = safe_norm(local.residual), safe_norm(frozen(there) - held)
    y = jnp.where(after <= before + options["rounding"], there, best)
    result = _status(frozen, held, y, options)
    slope = jax.jacfwd(search)(best).T @ (search(best) - query)
    step = newton_step(local, slope, free)
    y = y + step - jax.lax.stop_gradient(step)
    point = search(y)
    y = y[0] if len(search.intervals) == 1 else y
    return ParametricPoint(y, point, safe_norm(query - point), result)


def _status(search, query, y, options):
    """Whether the slope along every free parameter is in the rounding."""
    jacobian = jax.jacfwd(search)(y)
    residual = search(y) - query
    slope, speed = jacobian.T @ residual, safe_norm(jacobian, axis=0)
    widest = [max(abs(i.low), abs(i.high)) for i in search.intervals]
    # y itself is rounded, which moves the point by its speed.
    blur = jnp.finfo(y.dtype).eps * speed * jnp.asarray(widest, y.dtype)
    slack = 4 * options["rounding"] + 64 * blur
    free = is_free(jacobian, slope, y, options)
    met = jnp.abs(slope) <= jnp.where(free, slack * speed, jnp.inf)
    return failure_where(~jnp.all(met), RESULTS.not_converged)
