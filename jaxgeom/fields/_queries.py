"""Values, normals, nearest points and samples of any field."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import RESULTS, failure_where, safe_divide, safe_norm, safe_normalize
from ..shapes import Grid
from ._frozen import frozen


class SurfacePoint(eqx.Module):
    """A point [3] of the surface of a field, and whether it was reached."""

    point: Float[Array, " 3"]
    result: RESULTS


def value(field: Callable, points: Float[Array, "*n 3"]) -> Float[Array, "*n"]:
    """The values of a field at many points [..., 3]."""
    points = jnp.asarray(points)
    flat = jax.vmap(field)(points.reshape(-1, 3))
    return flat.reshape(points.shape[:-1])


def normal(field: Callable, point: Float[Array, " 3"]) -> Float[Array, " 3"]:
    """The unit outward normal grad f / |grad f| at one point; zero where grad f = 0."""
    return safe_normalize(jax.grad(field)(point))


def project(
    field: Callable, point: Float[Array, " 3"], *, num_steps: int = 8
) -> SurfacePoint:
    """The point pulled onto the surface along grad f: x <- x - f grad f / |grad f|^2.

    Converges quadratically; on an exact distance one step reaches the closest point.
    From far away the end is near to, but not the closest point: see `closest_point`.

    **Statuses:** `not_converged` where `num_steps` steps do not reach the surface, as
    where the gradient vanishes.

    Differentiable with respect to the field and the point, to any order.
    """
    step = lambda x, _: (x - _newton(field, x), None)
    found, _ = jax.lax.scan(step, point, length=num_steps)
    return SurfacePoint(found, _arrived(field, found, point))


def closest_point(
    field: Callable, point: Float[Array, " 3"], *, max_steps: int = 32
) -> SurfacePoint:
    """The nearest point x of the surface: f(x) = 0 with p - x = l grad f(x).

    Newton's method on these two equations, started from `project`; right for any smooth
    field, also where its values are no distances. Beyond a center of curvature, or
    where parts of the body are about equally near, it may end at a point that is
    nearest among its neighbors only.

    **Statuses:** `not_converged` after `max_steps`, or where the gradient vanishes.

    Differentiable once with respect to the field and the point, by the implicit
    function theorem at the solution.
    """
    found = _search(frozen(field), jax.lax.stop_gradient(point), max_steps)
    result = _arrived(field, found, point)
    # At the solution this step is zero, and its derivative is that of the solution.
    return SurfacePoint(found + _kkt_step(field, point, found), result)


def sample(field: Callable, grid: Grid, *, chunk: int = 65536) -> Float[Array, "x y z"]:
    """The values of a field at all nodes of a grid, `chunk` nodes at a time.

    Memory beyond the result is bounded by the field's needs at `chunk` points.
    """
    y, z = grid.shape[1:]

    def at_node(index):
        node = jnp.stack([index // (y * z), index // z % y, index % z])
        return field(grid.origin + grid.spacing * node.astype(grid.spacing.dtype))

    nodes = jnp.arange(math.prod(grid.shape), dtype=jnp.int32)
    values = jax.lax.map(at_node, nodes, batch_size=min(chunk, nodes.size))
    return values.reshape(grid.shape)


def _newton(field, x):
    """The shortest step to the zero of the linearised field; none where it is flat."""
    f, slope = jax.value_and_grad(field)(x)
    return safe_divide(f, jnp.dot(slope, slope)) * slope


def _kkt_step(field, point, x):
    """One Newton step from x towards f = 0, p - x = l grad f."""
    f, slope = jax.value_and_grad(field)(x)
    square = jnp.dot(slope, slope)
    multiplier = jax.lax.stop_gradient(safe_divide(jnp.dot(slope, point - x), square))
    eye = jnp.eye(3, dtype=x.dtype)
    curved = eye + multiplier * jax.lax.stop_gradient(jax.hessian(frozen(field))(x))
    # Where the field is flat the multiplier is free: fix it, to stay solvable.
    corner = jnp.where(square > 0, 0, 1).astype(x.dtype)
    column = jnp.append(slope, corner)[:, None]
    system = jnp.concatenate([jnp.vstack([curved, slope]), column], axis=1)
    return jnp.linalg.solve(system, jnp.append(point - x, -f))[:3]


def _search(field, point, max_steps):
    """The Newton steps from the projected point until they rest (no derivatives)."""

    def unrest(state):
        x, moved, steps = state
        return (moved > _resolution(point, x)) & (steps < max_steps)

    def advance(state):
        x, _, steps = state
        step = _kkt_step(field, point, x)
        return x + step, safe_norm(step), steps + 1

    first = project(field, point).point
    start = (first, jnp.asarray(jnp.inf, point.dtype), jnp.int32(0))
    return jax.lax.while_loop(unrest, advance, start)[0]


def _resolution(point, x):
    """The distance below which rounding decides where x lies."""
    return 16 * jnp.finfo(x.dtype).eps * (safe_norm(point) + safe_norm(x - point))


def _arrived(field, x, point):
    x, point = jax.lax.stop_gradient((x, point))
    f, slope = jax.value_and_grad(frozen(field))(x)
    reach = 16 * _resolution(point, x) * safe_norm(slope)
    return failure_where(~(jnp.abs(f) <= reach), RESULTS.not_converged)
