"""Heat that flows on a mesh for a short time, as a logarithm.

The solution of (M + t L) u = b falls like exp(-d / sqrt(t)) with the distance d: after
a few dozen edges it is below the rounding of any solver that measures the residual, and
after a hundred it is below the least float. Its logarithm is harmless. All entries of
the system that are off the diagonal are negative and everything else is positive, so
that Jacobi's iteration adds positive numbers only: it is exact in every digit at every
vertex, and can be done on logarithms.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._core import RESULTS


class HeatLog(eqx.Module):
    """-log u at every vertex (infinite where no heat comes), steps, and status."""

    value: Float[Array, " v"]
    steps: Int[Array, ""]
    result: RESULTS


class HeatSystem(eqx.Module):
    """u_i (m_i + sum_k w_ki) = b_i + sum_k w_ki u_{j(k,i)}, with w >= 0.

    `weights` [k, v] and `rows` [k, v] (the vertex j, v for none) belong to the
    neighbors of each vertex, `mass` [v] is m, `source` [v] tells where b is 1, not 0.
    """

    weights: Float[Array, "k v"]
    mass: Float[Array, " v"]
    rows: Int[Array, "k v"]
    source: Bool[Array, " v"]

    def step(self, log: Float[Array, " v"]) -> Float[Array, " v"]:
        """One iteration of Jacobi on -log u."""
        parts, own, low = _heat(self, log)
        total = jnp.sum(parts, axis=0) + own
        whole = self.mass + jnp.sum(self.weights, axis=0)
        heated = (total > 0) & (whole > 0)
        ratio = jnp.where(heated, whole, 1) / jnp.where(heated, total, 1)
        return jnp.where(heated, low + jnp.log(ratio), jnp.inf)

    def shares(self, log: Float[Array, " v"]) -> Float[Array, "k v"]:
        """How much of the heat at each vertex came from each neighbor."""
        parts, own, _ = _heat(self, log)
        total = jnp.sum(parts, axis=0) + own
        return parts / jnp.where(total > 0, total, 1)


def _heat(system, log):
    """What comes from every neighbor and from the source, and the log of the unit."""
    near = log.at[system.rows].get(mode="fill", fill_value=jnp.inf)
    there = (system.weights > 0) & jnp.isfinite(near)
    near = jnp.where(there, near, 0)
    low = jnp.min(jnp.where(there, near, jnp.inf), axis=0, initial=jnp.inf)
    low = jnp.where(system.source, jnp.minimum(low, 0), low)
    low = lax.stop_gradient(jnp.where(jnp.isfinite(low), low, 0))
    fading = jnp.exp(-jnp.where(there, near - low, 0))
    own = jnp.where(system.source, jnp.exp(low), 0)
    return jnp.where(there, system.weights * fading, 0), own, low


def solve_heat(system: HeatSystem, *, tolerance, max_steps: int) -> HeatLog:
    """-log u, until no value changes by more than `tolerance` (at most `max_steps`).

    The derivative is that of the exact solution: the iteration, linearised at its
    fixed point, hands changes on by the shares of the heat, and is iterated again.
    """
    still = lax.stop_gradient(system)
    first = jnp.where(still.source, 0.0, jnp.inf).astype(still.mass.dtype)
    least = jnp.asarray(tolerance, first.dtype)

    def unsettled(carry):
        _, change, steps = carry
        return (change > 0) & (steps < max_steps)

    def once(carry):
        old, _, steps = carry
        new = still.step(old)
        reached = jnp.isfinite(new)
        gap = jnp.where(reached, jnp.abs(jnp.where(reached, new - old, 0)), 0)
        # Beyond some distance the rounding of the logarithm is above any tolerance.
        rounding = 8 * jnp.finfo(new.dtype).eps * jnp.where(reached, jnp.abs(new), 0)
        moved = gap > jnp.maximum(least, rounding)
        return new, jnp.sum(moved, dtype=jnp.int32), steps + 1

    start = (first, jnp.int32(1), jnp.int32(0))
    value, change, steps = lax.while_loop(unsettled, once, start)
    value = _differentiable(system, still, value, least, max_steps)
    result = RESULTS.where(change > 0, RESULTS.not_converged, RESULTS.successful)
    return HeatLog(value, steps, result)


def _differentiable(system, still, value, tolerance, max_steps):
    """`value`, with the derivative of the fixed point (implicit function theorem)."""
    reached = jnp.isfinite(value)
    shares = still.shares(value)
    moved = jnp.where(reached, system.step(value), 0)
    change = moved - lax.stop_gradient(moved)

    def hand_on(x):
        return jnp.sum(shares * x.at[still.rows].get(mode="fill", fill_value=0), axis=0)

    def hand_back(y):
        out = jnp.zeros_like(y)
        return out.at[still.rows].add(shares * y, mode="drop")

    fixed_point = lambda walk: lambda b: _sum_of_walks(walk, b, tolerance, max_steps)
    answer = lax.custom_linear_solve(
        lambda x: x - hand_on(x),
        change,
        lambda _, b: fixed_point(hand_on)(b),
        transpose_solve=lambda _, b: fixed_point(hand_back)(b),
    )
    return jnp.where(reached, jnp.where(reached, value, 0) + answer, jnp.inf)


def _sum_of_walks(walk: Callable, b, tolerance, max_steps):
    """b + P b + P^2 b + ..., to a relative tolerance."""
    goal = jnp.minimum(tolerance, 1e-3) * jnp.max(jnp.abs(b), initial=0)

    def more(carry):
        _, term, steps = carry
        return (jnp.max(jnp.abs(term), initial=0) > goal) & (steps < max_steps)

    def once(carry):
        total, term, steps = carry
        term = walk(term)
        return total + term, term, steps + 1

    return lax.while_loop(more, once, (b, b, jnp.int32(0)))[0]
