"""Smooth signed distance: a field with the samples' values and gradients, least bent.

    E(u) = sum_p a_p (lambda_0 u(x_p)^2 + lambda_1 |grad u(x_p) - n_p|^2)
           + lambda_2 int |Hess u|^2,

lengths in spacings. W is trilinear interpolation, D_d the difference of neighbors along
axis d and W_d trilinear interpolation at the middles between them; the integral is
|L u|^2, L the 7-point Laplacian, to which it is equal up to the sides:

    (lambda_0 W^T a W + lambda_1 sum_d D_d^T W_d^T a W_d D_d + lambda_2 L^2) u
        = lambda_1 sum_d D_d^T W_d^T a n_d.

The preconditioner is a multigrid cycle of the root of the lumped operator, twice:
(L + sqrt(lambda_0 a / lambda_2))^-2. The solution is started coarse to fine.

Source: Calakli, Taubin, SSD: smooth signed distance surface reconstruction, CGF 2011.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._core import stage
from ..linear import (
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
from ._measured import Measured
from ._solution import FieldSolution

_COARSEST = 16
_COARSE_RTOL = 1e-3
_COARSE_STEPS = 30


class SSD(eqx.Module):
    """Smooth signed distance reconstruction (2011): smooth, fills gaps straight on.

    The values are distances near the samples, in the unit of the points. `value`,
    `gradient` and `bending` weigh the three terms of the energy, lengths in spacings.
    `levels`: as for `ScreenedPoisson`; `rtol`, `max_steps`: of the conjugate gradients.
    """

    value: Float[Array, ""] | float = 4.0
    gradient: Float[Array, ""] | float = 1.0
    bending: Float[Array, ""] | float = 0.25
    levels: int | None = eqx.field(static=True, default=None)
    rtol: float = 0.01
    max_steps: int = 300

    def __call__(self, cloud, grid, *, weights=None, token=None) -> FieldSolution:
        """The field of `cloud` on `grid`: negative inside, positive outside.

        Arguments and statuses as `screened_poisson`.
        """
        seen = Measured.of(cloud, grid, weights, self.levels, token)
        weigh = lambda w: jnp.asarray(w, seen.strength.dtype)
        system = _System(
            seen.q,
            seen.strength,
            weigh(self.value),
            weigh(self.gradient),
            weigh(self.bending),
            seen.unit / grid.spacing,
            token,
        )
        solution = conjugate_gradients(
            system,
            system.side(seen.normals, grid.shape),
            rtol=self.rtol,
            max_steps=self.max_steps,
            preconditioner=system.preconditioner(grid.shape),
            start=lambda b: _coarse_to_fine(b, system),
        )
        in_units = eqx.tree_at(lambda s: s.value, solution, solution.value * seen.unit)
        return seen.answer(in_units, system.value)


class _System(eqx.Module):
    """The operator of the energy for samples at node indices q.

    - `area`: [n]; `ratios`: [3], mean spacing over the spacing of each axis.
    """

    q: Float[Array, "n 3"]
    area: Float[Array, " n"]
    value: Float[Array, ""]
    gradient: Float[Array, ""]
    bending: Float[Array, ""]
    ratios: Float[Array, " 3"]
    token: Bool[Array, ""] | None

    def __call__(self, u):
        out = stage(self.token, self._bent, u)
        drawn = self.value * self.area * stage(self.token, interpolate, u, self.q)
        out = splat(drawn, self.q, u.shape, onto=out)
        for d in range(3):
            slope = interpolate(jnp.diff(u, axis=d), self._middle(d))
            out = out + self._back(d, slope * self.ratios[d], u.shape)
        return out

    def side(self, normals, shape) -> Float[Array, "x y z"]:
        """The right side for unit normals [n, 3]."""
        return sum(self._back(d, normals[:, d], shape) for d in range(3))

    def preconditioner(self, shape):
        """r -> (L + sqrt(lumped / bending))^-2 r / bending."""
        pull = self.value * self.area / self.bending
        lumped = stage(self.token, lambda p: splat(p, self.q, shape), pull)
        # Held first: the root has no slope where no samples are.
        root = jnp.sqrt(lax.stop_gradient(lumped))
        multigrid = Multigrid.of(root, self.ratios**2, self.token)
        scale = lax.stop_gradient(self.bending)
        return lambda r: multigrid.v_cycle(multigrid.v_cycle(r)) / scale

    def coarser(self, level) -> "_System":
        """The same energy for fields that are prolonged from a grid 2^level coarser."""
        q, _ = at_level(self.q, (2, 2, 2), level)
        # 8 nodes stand for one; differences are over twice the length, squared.
        weights = self.value, self.gradient / 4.0**level, self.bending / 2.0**level
        return _System(q, self.area, *weights, self.ratios, self.token)

    def _bent(self, u):
        along = self.ratios**2
        return self.bending * laplacian(laplacian(u, along), along)

    def _middle(self, d):
        return self.q.at[:, d].add(-0.5)

    def _back(self, d, slopes, shape):
        """lambda_1 D_d^T W_d^T a slopes."""
        middles = tuple(n - (axis == d) for axis, n in enumerate(shape))
        weights = self.gradient * self.ratios[d] * self.area * slopes
        nodes = splat(weights, self._middle(d), middles)
        width = [(int(axis == d), int(axis == d)) for axis in range(3)]
        return -jnp.diff(jnp.pad(nodes, width), axis=d)


def _coarse_to_fine(b, system):
    """The first iterate: solutions of coarser grids, prolonged."""
    system, sides = lax.stop_gradient(system), [b]
    while max(sides[-1].shape) > _COARSEST and min(sides[-1].shape) > 4:
        sides.append(restrict(sides[-1], token=system.token))
    u = jnp.zeros_like(sides[-1])
    for level in reversed(range(1, len(sides))):
        coarse = system.coarser(level)
        found = iterate(
            coarse,
            sides[level],
            rtol=_COARSE_RTOL,
            max_steps=_COARSE_STEPS,
            preconditioner=coarse.preconditioner(sides[level].shape),
            start=lambda _, u=u: u,
        )
        u = prolong(found.value, sides[level - 1].shape, token=system.token)
    return u
