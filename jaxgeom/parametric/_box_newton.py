"""A least-squares solver of optimistix for one or two bounded unknowns."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from .._core import safe_divide, safe_norm

_LEAST = 1e-12
FIRST_DAMPING = 1e-3
_MOST = 1e12
_FACTOR = 10.0


class _State(eqx.Module):
    damping: Float[Array, ""]
    done: Bool[Array, ""]


class BoxNewton(optx.AbstractLeastSquaresSolver):
    """Damped Newton steps on 1/2 |r(y)|^2 for y [d], d = 1 or 2, within bounds.

    The full Hessian J^T J + sum r_k d^2 r_k where it is positive, J^T J elsewhere, plus
    damping diag(J^T J). A coordinate at its bound whose slope points outwards is held
    (Bertsekas 1982); a step that raises the sum is not taken and the damping grows.
    The end is a step with |J dy| <= atol + rtol |r|, after which a Newton step would
    be right to the square of that; `closest_point` makes it.

    `options` of `optimistix.least_squares`: `lower`, `upper` [d] (infinite where there
    is no bound), `wrap`, a function that brings y back into its domain, and `rounding`,
    the error of |r|.
    """

    rtol: float
    atol: float
    norm: Callable = eqx.field(static=True, default=optx.max_norm)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        return _State(jnp.asarray(FIRST_DAMPING, y.dtype), jnp.asarray(False))

    def step(self, fn, y, args, options: dict[str, Any], state, tags):
        residual = lambda x: fn(x, args)[0]
        there, damping, moved = descent(residual, y, state.damping, options)
        reach = self.atol + self.rtol * safe_norm(residual(y))
        return there, _State(damping, (moved <= reach) | (damping > _MOST)), None

    def terminate(self, fn, y, args, options, state, tags):
        return state.done, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def descent(residual: Callable, y, damping, options):
    """One damped step from y: the new y, the next damping, and the length |J dy| tried.

    y stays where it is if |r| would grow by more than `options["rounding"]`.
    """
    local = model(residual, y)
    change = -_damped(local, is_free(local.jacobian, local.slope, y, options), damping)
    there = options["wrap"](y + change)
    before, after = safe_norm(local.residual), safe_norm(residual(there))
    better = after <= before + options["rounding"]
    damping = jnp.where(better, damping / _FACTOR, damping * _FACTOR)
    moved = safe_norm(local.jacobian @ change)
    return jnp.where(better, there, y), jnp.maximum(damping, _LEAST), moved


class Model(eqx.Module):
    """A residual [k], its derivatives [k, d] and the Hessian of 1/2 |r|^2 [d, d]."""

    residual: Float[Array, " k"]
    jacobian: Float[Array, "k d"]
    hessian: Float[Array, "d d"]

    @property
    def slope(self) -> Float[Array, " d"]:
        """J^T r."""
        return self.jacobian.T @ self.residual


def model(residual: Callable, y: Float[Array, " d"]) -> Model:
    """The residual at y and all that a Newton step needs."""
    # One nested pass: each order also returns the one below it.
    value = lambda x: (lambda r: (r, r))(residual(x))
    first = jax.jacfwd(value, has_aux=True)
    second, (j, r) = jax.jacfwd(
        lambda x: (lambda d: (d[0], d))(first(x)), has_aux=True
    )(y)
    return Model(r, j, j.T @ j + jnp.tensordot(r, second, 1))


def is_free(jacobian, slope, y, options) -> Bool[Array, " d"]:
    """True for coordinates that may move: not pressed to a bound, and not without
    effect, as the angle at a pole."""
    held = (y <= options["lower"]) & (slope > 0) | (y >= options["upper"]) & (slope < 0)
    return ~held & (jnp.sum(jacobian**2, axis=0) > 0)


def newton_step(hessian, slope, free) -> Float[Array, " d"]:
    """-H^-1 slope in the free coordinates (d = 1 or 2); zero where H is singular."""
    both = free[:, None] & free[None, :]
    h = jnp.where(both, hessian, jnp.eye(len(slope), dtype=slope.dtype))
    g = jnp.where(free, slope, 0)
    if len(slope) == 1:
        return -safe_divide(g, h[0])
    adjugate = jnp.array([[1, -1], [-1, 1]], g.dtype) * h[::-1, ::-1].T
    return -safe_divide(adjugate @ g, _determinant(h))


def _damped(local, free, damping):
    gauss = local.jacobian.T @ local.jacobian
    lift = damping * jnp.diag(jnp.diagonal(gauss))
    both = free[:, None] & free[None, :]
    held = jnp.where(both, local.hessian, jnp.eye(len(free), dtype=gauss.dtype))
    eps = jnp.finfo(gauss.dtype).eps
    least = 16 * eps * jnp.prod(jnp.where(free, jnp.diagonal(gauss), 1))
    positive = (_determinant(held) > least) & jnp.all(jnp.diagonal(held) > 0)
    hessian = jnp.where(positive, local.hessian, gauss)
    return -newton_step(hessian + lift, local.slope, free)


def _determinant(h):
    return h[0, 0] if len(h) == 1 else h[0, 0] * h[1, 1] - h[0, 1] * h[1, 0]
