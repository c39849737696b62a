"""Conjugate gradients with a true status, differentiable through the solution."""

from collections.abc import Callable

import equinox as eqx
import jax
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
    number of steps. Where a Hessian depends on the residual or the status, take
    `jax.jacrev(jax.grad(f))`: `jax.hessian` raises an error about `out_axes`, since JAX
    batches whatever a linear solve returns beside the solution.

    **Arguments:**

    - `operator`: x -> A x, linear; `preconditioner`: r -> M r, symmetric positive.
    - `b`: an array of any shape; `start`: b -> the first iterate (zero by default).
    - `rtol`: stop when |b - A x| <= rtol |b|; `max_steps`: at most so many steps.

    Hestenes and Stiefel (1952).
    """

    # The transposed system is the same one: under jit it is traced only once.
    @jax.jit
    def solve(rhs):
        out = iterate(
            operator,
            rhs,
            rtol=rtol,
            max_steps=max_steps,
            preconditioner=preconditioner,
            start=start,
        )
        return out.value, (out.residual, out.steps, out.result)

    x, (residual, steps, result) = lax.custom_linear_solve(
        operator, b, lambda _, rhs: solve(rhs), symmetric=True, has_aux=True
    )
    return LinearSolution(x, residual, steps, result)


class _State(eqx.Module):
    """Where the iteration stands; `square` is |r|^2, `checked` what it was when the
    residual was last recomputed."""

    x: Float[Array, "..."]
    r: Float[Array, "..."]
    p: Float[Array, "..."]
    rz: Float[Array, ""]
    square: Float[Array, ""]
    checked: Float[Array, ""]
    steps: Int[Array, ""]
    phase: Int[Array, ""]


# The first pass finds the residual of the start, a closing one the true residual.
_OPENING, _ITERATING, _CLOSING, _DONE = range(4)


def iterate(
    matvec, b, *, rtol, max_steps, preconditioner, start, dot=jnp.vdot
) -> LinearSolution:
    """`conjugate_gradients` without derivative, for use inside other solvers.

    Every pass of the loop applies the operator once, to the iterate or to a direction,
    so that a large operator is compiled once. Where the recursive residual has arrived
    and the true one has not, the iteration begins anew from there, unless the last time
    that helped by less than a factor of two. `dot` is the inner product: that of grids
    in parts sums over the parts.
    """
    goal = jnp.asarray(rtol, b.dtype) ** 2 * dot(b, b)
    x = start(b)
    # Whatever p is, an infinite rz makes the first direction z itself.
    big, none = jnp.full((), jnp.inf, b.dtype), jnp.int32(0)
    first = _State(x, b, x, big, big, big, none, jnp.int32(_OPENING))

    def direction(state):
        z = preconditioner(state.r)
        rz = dot(state.r, z)
        return z + safe_divide(rz, state.rz) * state.p, rz

    def step(state):
        exact = state.phase != _ITERATING
        at_iterate = lambda s: (s.x, big)
        p, rz = lax.cond(exact, at_iterate, direction, state)
        q = matvec(p)
        # A vanishing curvature means that the residual is rounding error already.
        length = jnp.where(exact, 0, safe_divide(rz, dot(p, q)))
        r = jnp.where(exact, b, state.r) - jnp.where(exact, 1, length) * q
        square, steps = dot(r, r), state.steps + ~exact
        more = (square > goal) & (steps < max_steps)
        more &= ~exact | (square < state.checked / 4)
        phase = jnp.where(more, _ITERATING, jnp.where(exact, _DONE, _CLOSING))
        checked = jnp.where(exact, square, state.checked)
        x, phase = state.x + length * p, phase.astype(jnp.int32)
        return _State(x, r, p, rz, square, checked, steps, phase)

    end = lax.while_loop(lambda s: s.phase != _DONE, step, first)
    residual = jnp.sqrt(safe_divide(end.square, dot(b, b)))
    converged = residual <= rtol
    result = RESULTS.where(converged, RESULTS.successful, RESULTS.not_converged)
    return LinearSolution(end.x, residual, end.steps, result)
