"""The minimiser of the screened energy: conjugate gradients, started coarse to fine.

The operator A = L + W^T diag(pull) W is preconditioned by a V-cycle in which the pull
is lumped to the diagonal. The start is the solution on the grid of twice the spacing,
a few steps of the same method on 2 L + W_1^T diag(pull) W_1 with the samples at their
coarse indices, so that two or three steps on the finest grid are left to do.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._core import stage
from ..linear import (
    LinearSolution,
    Multigrid,
    conjugate_gradients,
    interpolate,
    iterate,
    laplacian,
    prolong,
    restrict,
    splat,
)
from ._density import at_level

_COARSE_STEPS = 5
_WALL = 100.0


class _System(eqx.Module):
    """u -> 2^l L u + walls u + W_l^T diag(pull) W_l u on the grid of level l."""

    q: Float[Array, "n 3"]
    pull: Float[Array, " n"]
    coefficients: Float[Array, " 3"]
    walls: Float[Array, "x y z"] | None
    token: Bool[Array, ""] | None

    def __call__(self, u):
        smooth = stage(self.token, lambda u: laplacian(u, self.coefficients), u)
        drawn = self.pull * stage(self.token, interpolate, u, self.q)
        out = stage(self.token, _add_splat, smooth, drawn, self.q)
        return out if self.walls is None else out + self.walls * u

    def coarser(self, shape) -> "_System":
        """The same energy on the next grid; it only helps to start, so it is held."""
        q, _ = at_level(self.q, shape, 1)
        walls = None if self.walls is None else restrict(self.walls)
        return lax.stop_gradient(
            _System(q, self.pull, 2 * self.coefficients, walls, self.token)
        )


def _add_splat(u, weights, q):
    return splat(weights, q, u.shape, onto=u)


def minimise(
    side: Float[Array, "x y z"],
    q: Float[Array, "n 3"],
    pull: Float[Array, " n"],
    coefficients: Float[Array, " 3"],
    fixed: Bool[Array, "x y z"] | None,
    *,
    rtol: float,
    max_steps: int,
    token: Bool[Array, ""] | None = None,
) -> LinearSolution:
    """The solution of (L + W^T diag(pull) W) u = side, +1/2 at the `fixed` nodes."""
    shape = side.shape
    system = _System(q, pull, coefficients, None, token)
    lumped = stage(token, lambda p: splat(p, q, shape), pull)
    settings = dict(rtol=rtol, max_steps=max_steps)
    if fixed is None:
        multigrid = Multigrid.of(lumped, coefficients, token)
        start = lambda b: _coarse_to_fine(b, system, multigrid)
        return conjugate_gradients(
            system, side, **settings, preconditioner=multigrid.v_cycle, start=start
        )
    hold = lambda u, value=0.0: jnp.where(fixed, value, u)
    # Fixed nodes are walls to the preconditioner, stiffer than any neighbor.
    walls = hold(jnp.zeros_like(side), _WALL * jnp.max(coefficients))
    walled = eqx.tree_at(lambda s: s.walls, system, walls, is_leaf=lambda x: x is None)
    multigrid = Multigrid.of(lumped + walls, coefficients, token)
    outside = hold(jnp.zeros_like(side), 0.5)
    out = conjugate_gradients(
        lambda u: hold(system(hold(u)), u),
        hold(side - system(outside)),
        **settings,
        preconditioner=lambda r: hold(multigrid.v_cycle(hold(r))),
        start=lambda b: hold(_coarse_to_fine(b, walled, multigrid)),
    )
    return eqx.tree_at(lambda s: s.value, out, out.value + outside)


def _coarse_to_fine(b, system: Callable, multigrid: Multigrid):
    """The first iterate: a few steps on the next coarser grid, prolonged."""
    if len(multigrid.diagonals) == 1:
        return multigrid.v_cycle(b)
    token = system.token
    coarse = iterate(
        system.coarser(b.shape),
        restrict(b, token=token),
        rtol=0.0,
        max_steps=_COARSE_STEPS,
        preconditioner=lambda r: multigrid.v_cycle(r, 1),
        start=lambda b: multigrid.full(b, 1),
    )
    return prolong(coarse.value, b.shape, token=token)
