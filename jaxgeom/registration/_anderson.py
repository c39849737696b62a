"""Fewer searches for pairs: a step extrapolated from the last few.

An alternation is a fixed-point iteration x -> x + f(x) of the pose. Anderson's mixing
takes the combination of the last steps whose f is shortest,

    z = f - sum_j c_j (df_j + dx_j),   c = argmin |f - sum_j c_j df_j|^2,

where df_j and dx_j are the changes of f and of x from one of the last steps to the
next. With one coordinate it is the secant method. Poses are added up in the coordinates
of their steps, which is exact to first order; a fixed point stays one, as z = 0 where
f = 0.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from ._solvers import AbstractSolver, Alternation, Step

# Costs are compared as long as a step narrows the kernel by less than a hundredth.
_SAME = 0.99


class Mixing(eqx.Module):
    """The last steps: changes of f and of x, row `count` modulo m the next to fill."""

    inner: PyTree
    step_changes: Float[Array, "m k"]
    place_changes: Float[Array, "m k"]
    count: Int[Array, ""]
    last_step: Float[Array, " k"]
    last_move: Float[Array, " k"]
    cost: Float[Array, ""]
    width: Float[Array, ""]
    mixed: Bool[Array, ""]


class Anderson(AbstractSolver):
    """Steps of another solver, extrapolated from the last `depth` of them.

    Where an extrapolated step has raised the mean cost of the pairs at the same width
    of the kernel, it is taken back to the plain one and the memory is cleared; it is
    cleared also where the width has changed.

    Source: Anderson 1965; Zhang, Yao, Deng 2021, Fast and robust iterative closest
    point, 3.2 (for the alternation, with such a safeguard).
    """

    solver: AbstractSolver = Alternation()
    depth: int = eqx.field(static=True, default=5)

    def start(self, size, dtype):
        table = jnp.zeros((self.depth, size), dtype)
        row, one = jnp.zeros(size, dtype), jnp.asarray(jnp.inf, dtype)
        count = jnp.zeros((), jnp.int32)
        inner = self.solver.start(size, dtype)
        return Mixing(inner, table, table, count, row, row, one, one, count > 0)

    def validate(self, objective, model):
        self.solver.validate(objective, model)

    def step(self, problem, memory):
        inner = self.solver.step(problem, memory.inner)
        tangent, model = problem.tangent, problem.model
        still = type(inner.transform).identity(tangent.basis.dtype)
        step = tangent.coordinates(model.difference(inner.transform, still))
        total = jnp.sum(problem.weights)
        cost = problem.energy(jnp.zeros_like(step)) / jnp.where(total > 0, total, 1)
        same = problem.width >= _SAME * memory.width
        worse = memory.mixed & same & (cost > memory.cost)
        filled = _remember(memory, step)
        z = _mixed(filled, step)
        # Taken back: from the extrapolated place to that of the plain step.
        z = jnp.where(worse, memory.last_step - memory.last_move, z)
        plain = ~(jnp.all(jnp.isfinite(z)) & (same | worse))
        z = jnp.where(plain, step, z)
        kept = same & ~worse
        memory = Mixing(
            inner.memory,
            filled.step_changes,
            filled.place_changes,
            jnp.where(kept, filled.count, 0),
            step,
            z,
            jnp.where(worse, memory.cost, cost),
            problem.width,
            kept & ~plain & (filled.count > 0),
        )
        move = model.exp(tangent.basis @ z)
        return Step(move, memory, inner.stuck)


def _remember(memory: Mixing, step) -> Mixing:
    """The memory with the changes since the last step; none before the second."""
    first = jnp.isinf(memory.width)
    slot = memory.count % memory.step_changes.shape[0]
    put = lambda table, row: table.at[slot].set(row)
    return eqx.tree_at(
        lambda m: (m.step_changes, m.place_changes, m.count),
        memory,
        (
            put(memory.step_changes, step - memory.last_step),
            put(memory.place_changes, memory.last_move),
            jnp.where(first, 0, memory.count + 1),
        ),
    )


def _mixed(memory: Mixing, step):
    """z = f - sum_j c_j (df_j + dx_j), by damped normal equations."""
    depth = memory.step_changes.shape[0]
    real = (jnp.arange(depth) < memory.count)[:, None]
    rows = jnp.where(real, memory.step_changes, 0)
    gram = rows @ rows.T
    # Old steps are longer by orders: each row is damped by its own length.
    diagonal = jnp.diagonal(gram)
    some = diagonal > 0
    eps = jnp.finfo(step.dtype).eps
    damping = jnp.where(some, eps ** (1 / 2) * diagonal, 1)
    shares = jnp.linalg.solve(gram + jnp.diag(damping), rows @ step)
    past = jnp.where(real, memory.step_changes + memory.place_changes, 0)
    return step - shares @ past
