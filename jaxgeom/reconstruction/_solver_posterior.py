"""The solver posterior: what the energy of screened Poisson leaves open.

Its energy E(u) = u^T A u - 2 b^T u + const, A = L + W^T diag(pull) W, taken for minus
twice the logarithm of a density at the temperature tau, makes u a Gaussian of mean
A^-1 b and covariance tau A^-1. With L = G^T G and white noise xi on the edges of the
grid and at the samples, one more solve of the same system is one sample of it:

    A u = b + sqrt(tau) (G^T xi_1 + W^T sqrt(pull) xi_2).

Cheap, and another distribution than that of `stochastic_poisson`: the gradient of u
errs by independent amounts everywhere, and only the pull of the samples holds u.

After G. Papandreou, A. Yuille, Gaussian sampling by local perturbations, 2010 (perturb,
then minimise).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Key

from .._core import (
    RESULTS,
    GeometryError,
    failure_where,
    first_failure,
    message,
    safe_divide,
)
from ..linear import interpolate, splat
from ..shapes import Grid, PointCloud
from ._boundary import Neumann
from ._poisson import ScreenedPoisson, System, solution_of, system_of
from ._solution import FieldSolution


class SolverPosterior(eqx.Module):
    """A sampled Gaussian distribution of fields about that of screened Poisson.

    - `mean`: the solution of `screened_poisson`.
    - `samples`: [s, x, y, z] fields less the level of the mean: negative inside. For
      `probability_hit`, `view_score`, `next_view` and `face_probability`.
    - `temperature`: tau. `result`: of the mean, then of the samples.
    """

    mean: FieldSolution
    samples: Float[Array, "s x y z"]
    temperature: Float[Array, ""]
    result: RESULTS

    @property
    def grid(self) -> Grid:
        """The grid of the mean and of the samples."""
        return self.mean.grid

    def std(self, points: Float[Array, "m 3"]) -> Float[Array, " m"]:
        """The standard deviation of the samples at points."""
        q = self.grid.index_of(points)
        values = lax.map(lambda field: interpolate(field, q), self.samples)
        return jnp.std(values, axis=0)


def solver_posterior(
    cloud: PointCloud,
    grid: Grid,
    *,
    key: Key[Array, ""],
    num: int = 32,
    method: ScreenedPoisson | None = None,
    temperature: Float[Array, ""] | float | None = None,
    weights: Float[Array, " n"] | None = None,
) -> SolverPosterior:
    """Screened Poisson reconstruction with samples of what its energy leaves open.

    **Arguments:**

    - `cloud`, `grid`, `weights`: as in `screened_poisson`.
    - `key`: a typed key, used once; `num`: samples, each costs one solve.
    - `method`: `ScreenedPoisson(rtol=1e-3)` by default; its sides must be `Neumann()`,
      and its screening positive, since nothing else holds u.
    - `temperature`: tau; None: the mean of pull_p (u(x_p) - level)^2 over the samples,
      that of which their own residuals speak. The deviations grow with its root.

    **Statuses:** as `screened_poisson`. Raises `GeometryError` for other
    sides, and for a screening that is not positive.
    """
    method = ScreenedPoisson(rtol=1e-3, max_steps=100) if method is None else method
    if not isinstance(method.boundary, Neumann):
        raise GeometryError(
            message(
                "the sides of a solver posterior must be Neumann()",
                f"{type(method.boundary).__name__}",
                "Leave a wide margin around the cloud instead.",
            )
        )
    if isinstance(method.screening, int | float) and not method.screening > 0:
        raise GeometryError(
            message(
                "the screening of a solver posterior must be positive",
                f"screening={method.screening}",
                "Pass None, or from 0.1 (noisy) to 32 (clean and dense).",
            )
        )
    system = system_of(cloud, grid, method, method.screening, weights, None)
    solution = solution_of(system, method, None)
    mean = system.seen.answer(solution, system.screening)
    if temperature is None:
        left = interpolate(solution.value, system.seen.q) - mean.level
        count = jnp.sum(system.pull > 0).astype(left.dtype)
        temperature = safe_divide(jnp.sum(system.pull * left**2), count)
    tau = jnp.asarray(temperature, solution.value.dtype)

    def one(key):
        noise = jnp.sqrt(tau) * _noise(key, system)
        moved = eqx.tree_at(lambda s: s.side, system, system.side + noise)
        found = solution_of(moved, method, None)
        return found.value - mean.level, found.residual <= method.rtol

    samples, ended = lax.map(one, jax.random.split(key, num))
    late = failure_where(~jnp.all(ended), RESULTS.not_converged)
    return SolverPosterior(mean, samples, tau, first_failure(mean.result, late))


def _noise(key, system: System) -> Float[Array, "x y z"]:
    """A Gaussian of covariance A: G^T xi_1 + W^T sqrt(pull) xi_2."""
    shape, dtype = system.side.shape, system.side.dtype
    *edges, last = jax.random.split(key, 4)
    at_samples = jax.random.normal(last, system.pull.shape, dtype)
    white = [
        jax.random.normal(edge, tuple(n - (d == e) for e, n in enumerate(shape)), dtype)
        for d, edge in enumerate(edges)
    ]
    return coloured(white, at_samples, system)


def coloured(white, at_samples, system: System) -> Float[Array, "x y z"]:
    """G^T of values on the edges along each axis, and W^T sqrt(pull) of some at the
    samples; the product of this map with its transpose is A."""
    out = splat(jnp.sqrt(system.pull) * at_samples, system.seen.q, system.side.shape)
    for d, along in enumerate(white):
        ends = [(1, 1) if e == d else (0, 0) for e in range(3)]
        difference = jnp.diff(jnp.pad(along, ends), axis=d)
        out = out - jnp.sqrt(system.coefficients[d]) * difference
    return out
