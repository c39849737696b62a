"""Poisson and screened Poisson surface reconstruction on a dense grid.

Samples x_p with unit outward normals n_p stand for areas a_p. The indicator u of the
solid (-1/2 inside, +1/2 outside) minimises

    E(u) = int |grad u - V|^2 + (alpha / h) sum_p a_p u(x_p)^2,
    V = sum_p a_p n_p K(x - x_p) / h^3,

with K the tensor quadratic B-spline as wide as the grid spacing h. In units of h,

    (L + alpha W^T diag(a) W) u = sum_p a_p n_p . grad K(q_p - i),

L the 7-point Laplacian, W trilinear interpolation at the samples. alpha = 0 is Kazhdan,
Bolitho, Hoppe (2006); alpha > 0, which pulls the surface to the samples, is Kazhdan and
Hoppe (2013). Multiplying alpha by 2 when h halves, their rule, is what 1 / h does.

Where a sample stands for more than a cell, its normal is smeared by the kernel of a
coarser grid, so that sparse parts of a scan close as well as dense ones.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..linear import LinearSolution, cosine_solve
from ..shapes import Grid, PointCloud
from ._boundary import AbstractBoundary, Neumann
from ._divergence import divergence
from ._measured import Measured, without_steps
from ._minimise import minimise
from ._solution import FieldSolution


class Poisson(eqx.Module):
    """Plain Poisson reconstruction (2006): smooth, and blind to where exactly the
    samples lie. With Neumann sides it is one cosine transform, without iteration.

    `levels`: how many coarser grids sparse samples may use (static); None: from the
    number of samples and the resolution.
    """

    boundary: AbstractBoundary = Neumann()
    levels: int | None = eqx.field(static=True, default=None)
    rtol: float = 0.05
    max_steps: int = 50

    def __call__(self, cloud, grid, *, weights=None, token=None) -> FieldSolution:
        """The field of `cloud` on `grid`; see `poisson`."""
        return _solve(cloud, grid, self, 0.0, weights, token)


class ScreenedPoisson(eqx.Module):
    """Screened Poisson reconstruction (2013): the surface is pulled to the samples.

    `screening`: alpha, from 0.1 (noisy) to 32 (clean and dense), may be an array; None
    chooses it from the noise of the samples. Other fields as in `screened_poisson`.
    """

    screening: Float[Array, ""] | float | None = None
    boundary: AbstractBoundary = Neumann()
    levels: int | None = eqx.field(static=True, default=None)
    rtol: float = 0.05
    max_steps: int = 50

    def __call__(self, cloud, grid, *, weights=None, token=None) -> FieldSolution:
        """The field of `cloud` on `grid`; see `screened_poisson`."""
        return _solve(cloud, grid, self, self.screening, weights, token)


def poisson(cloud: PointCloud, grid: Grid, *, weights=None, token=None, **settings):
    """The Poisson field of an oriented cloud: -1/2 inside, +1/2 outside, roughly.

    **Arguments:** as `screened_poisson`, without screening.
    """
    return Poisson(**settings)(cloud, grid, weights=weights, token=token)


def screened_poisson(
    cloud: PointCloud,
    grid: Grid,
    *,
    weights: Float[Array, " n"] | None = None,
    token: Bool[Array, ""] | None = None,
    **settings,
) -> FieldSolution:
    """The screened Poisson field of an oriented cloud.

    **Arguments:**

    - `cloud`: points with outward normals (any length; only directions count).
    - `grid`: should leave at least two cells around the cloud.
    - `weights`: [n], confidence of each sample, nonnegative; 1 by default.
    - `token`: see `jaxgeom._core.stage`; None is right, only slower on CPUs.
    - `screening`: alpha, dimensionless; None: from the noise of the samples.
    - `boundary`: `Neumann()`, `Dirichlet()` or `Envelope(outside)`.
    - `levels`: static, how many coarser grids sparse samples may use; None: from the
      number of samples and the resolution.
    - `rtol`, `max_steps`: of the conjugate gradients.

    **Statuses** (`.result`): `too_few_points`, `zero_normals` (samples ignored),
    `outside_grid` (samples ignored), `not_converged`, `nonfinite_input`.

    Kazhdan and Hoppe (2013), "Screened Poisson surface reconstruction".
    """
    method = ScreenedPoisson(**settings)
    return method(cloud, grid, weights=weights, token=token)


class System(eqx.Module):
    """What is solved: (L + W^T diag(pull) W) u = side; coefficients weigh L."""

    seen: Measured
    side: Float[Array, "x y z"]
    pull: Float[Array, " n"]
    coefficients: Float[Array, " 3"]
    screening: Float[Array, ""]


def _solve(cloud, grid, method, screening, weights, token) -> FieldSolution:
    system = system_of(cloud, grid, method, screening, weights, token)
    return system.seen.answer(solution_of(system, method, token), system.screening)


def system_of(cloud, grid, method, screening, weights, token) -> System:
    """The linear system of a cloud; `screening` None is chosen from its noise."""
    seen = Measured.of(cloud, grid, weights, method.levels, token)
    found, ratios = seen.geometry, seen.unit / grid.spacing
    if screening is None:
        screening = _screening_for(found.noise)
    screening = jnp.asarray(screening, cloud.points.dtype)
    vectors = seen.normals * ratios * seen.strength[:, None]
    side = divergence(seen.q, vectors, found.area, grid.shape, seen.levels, token=token)
    # A sample of many cells belongs to a coarser grid, whose 1 / h is weaker.
    pull = screening * seen.strength / jnp.sqrt(jnp.maximum(found.area, 1.0))
    return System(seen, side, pull, ratios**2, screening)


def solution_of(system: System, method, token) -> LinearSolution:
    """The solution, with the sides of the method."""
    fixed = method.boundary.fixed(system.side.shape)
    if fixed is None and isinstance(method, Poisson):
        value = cosine_solve(system.side, system.coefficients)
        return without_steps(value)
    settings = dict(rtol=method.rtol, max_steps=method.max_steps, token=token)
    parts = (system.side, system.seen.q, system.pull, system.coefficients)
    return minimise(*parts, fixed, **settings)


def _screening_for(noise):
    """alpha for samples whose noise is `noise` spacings.

    The pull should not resolve what is noise. On meshes sampled with known noise the
    error is least near alpha = 2 at 0.23 spacings and 0.5 at 0.5; the cube between
    them leaves clean scans, where the estimate is mostly curvature, well screened.
    """
    floor = _CLEAN_NOISE * jnp.ones_like(noise)
    return jnp.maximum(_NOISE_CONSTANT / jnp.maximum(noise, floor) ** 3, 0.25)


_NOISE_CONSTANT = 0.046
# Beyond alpha = 16 accuracy gains little and the solver needs more steps.
_CLEAN_NOISE = 0.142
