"""Geometric multigrid for A = L + D: the Neumann Laplacian plus a diagonal.

Level l has the operator A_l = 2^l L_l + D_l with D_{l+1} = P^T D_l, the Galerkin
scaling for the trilinear prolongation P in three dimensions. A V-cycle with one
damped-Jacobi sweep before and after is a symmetric positive preconditioner; full
multigrid, coarse to fine, is a start that leaves a few steps to do. The diagonal must
be seen on all levels: ignoring it there costs three times the steps.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._core import stage
from ._stencils import laplacian, laplacian_diagonal
from ._transfer import prolong, restrict

DAMPING = 0.85
_COARSEST = 16
_COARSEST_SWEEPS = 12


class Multigrid(eqx.Module):
    """The hierarchy of one operator L + D.

    **Arguments of `Multigrid.of`:**

    - `diagonal`: D [x, y, z], nonnegative, positive somewhere.
    - `coefficients`: [3], the weights of the axes in L.
    - `token`: a run-time true that keeps the sweeps apart (see `stage`), or None.
    """

    diagonals: tuple[Float[Array, "x y z"], ...]
    coefficients: Float[Array, " 3"]
    token: Bool[Array, ""] | None

    @staticmethod
    def of(diagonal, coefficients, token=None) -> "Multigrid":
        """The hierarchy down to a grid of at most 16 nodes an axis."""
        diagonals = [lax.stop_gradient(diagonal)]  # the solution does not depend on it
        while max(diagonals[-1].shape) > _COARSEST and min(diagonals[-1].shape) > 4:
            diagonals.append(restrict(diagonals[-1], token=token))
        return Multigrid(tuple(diagonals), lax.stop_gradient(coefficients), token)

    def v_cycle(
        self, r: Float[Array, "x y z"], level: int = 0
    ) -> Float[Array, "x y z"]:
        """An approximation of A_l^-1 r, linear and symmetric in r."""
        if level + 1 == len(self.diagonals):
            return stage(self.token, self._coarsest, r)
        u, defect = stage(self.token, lambda r: self._first_sweep(r, level), r)
        coarse = self.v_cycle(restrict(defect, token=self.token), level + 1)
        u = prolong(coarse, u.shape, onto=u, token=self.token)
        return stage(self.token, lambda u, r: self._sweep(u, r, level), u, r)

    def full(self, b: Float[Array, "x y z"], level: int = 0) -> Float[Array, "x y z"]:
        """An approximation of A_l^-1 b: every level starts from the coarser solution,
        and the finest is that solution prolonged."""
        if level + 1 == len(self.diagonals):
            return stage(self.token, self._coarsest, b)
        side = restrict(b, token=self.token)
        u = self.full(side, level + 1)
        if level + 2 < len(self.diagonals):
            defect = lambda u, b: b - self._apply(u, level + 1)
            u = u + self.v_cycle(stage(self.token, defect, u, side), level + 1)
        return prolong(u, b.shape, token=self.token)

    def _apply(self, u, level):
        return laplacian(u, 2.0**level * self.coefficients) + self.diagonals[level] * u

    def _step(self, level):
        diagonal = laplacian_diagonal(
            self.diagonals[level].shape, 2.0**level * self.coefficients
        )
        return DAMPING / (diagonal + self.diagonals[level])

    def _first_sweep(self, r, level):
        u = self._step(level) * r
        return u, r - self._apply(u, level)

    def _sweep(self, u, r, level):
        return u + self._step(level) * (r - self._apply(u, level))

    def _coarsest(self, r):
        last = len(self.diagonals) - 1
        sweep = lambda _, u: self._sweep(u, r, last)
        return lax.fori_loop(0, _COARSEST_SWEEPS, sweep, jnp.zeros_like(r))
