"""Conjugate gradients with a true status, differentiable through the solution."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .._core import RESULTS, safe_divide


class LinearSolution(eqx.Module):
    """The solution of A x = b with how it was reached.

    `residual` is |b - A x| / |b|, recomputed at the end: in single precision the
    recursive residual may be far below it. `result` is `not_converged` where it exceeds
    the tolerance.
    """

    value: Float[Array, "..."]
    residual: Float[Array, ""]
    steps: Int[Array, ""]
    result: RESULTS


def conjugate_gradients(
    operator: Callable,
    b: Float[Array, "..."],
    *,
    rtol: float,
    max_steps: int,
    preconditioner: Callable = lambda r: r,
    start: Callable = jnp.zeros_like,
) -> LinearSolution:
    """The solution of A x = b for a symmetric positive (semi)definite operator.

    The derivative with respect to b and to everything that `operator` closes over is
    that of the exact solution (implicit function theorem): one more solve, whatever the
    number of steps.

    **Arguments:**

    - `operator`: x -> A x, linear; `preconditioner`: r -> M r, symmetric positive.
    - `b`: an array of any shape; `start`: b -> the first iterate (zero by default).
    - `rtol`: stop when |b - A x| <= rtol |b|; `max_steps`: at most so many steps.

    Hestenes and Stiefel (1952).
    """

    def solve(matvec, rhs):
        return _iterate(matvec, rhs, rtol, max_steps, preconditioner, start)

    x, (residual, steps) = lax.custom_linear_solve(
        operator, b, solve, symmetric=True, has_aux=True
    )
    converged = residual <= rtol
    result = RESULTS.where(converged, RESULTS.successful, RESULTS.not_converged)
    return LinearSolution(x, residual, steps, result)


def _iterate(matvec, b, rtol, max_steps, preconditioner, start):
    goal = jnp.asarray(rtol, b.dtype) ** 2 * jnp.vdot(b, b)
    x = start(b)
    r = b - matvec(x)
    first = (x, r, jnp.zeros_like(b), jnp.ones((), b.dtype), jnp.vdot(r, r))

    def going(state):
        (*_, square), steps = state
        return (square > goal) & (steps < max_steps)

    def step(state):
        (x, r, p, rz_before, _), steps = state
        z = preconditioner(r)
        rz = jnp.vdot(r, z)
        # The first direction is z itself: p is zero there, whatever the factor.
        p = z + safe_divide(rz, rz_before) * p
        q = matvec(p)
        # A vanishing curvature means that the residual is rounding error already.
        length = safe_divide(rz, jnp.vdot(p, q))
        r = r - length * q
        return (x + length * p, r, p, rz, jnp.vdot(r, r)), steps + 1

    (x, *_), steps = lax.while_loop(going, step, (first, jnp.int32(0)))
    r = b - matvec(x)
    residual = jnp.sqrt(safe_divide(jnp.vdot(r, r), jnp.vdot(b, b)))
    return x, (residual, steps)
