"""Stochastic Poisson reconstruction: all fields that oriented points allow.

The vector field v whose values at the samples are their normals is a Gaussian process,
each component alone, n_p = v(x_p) + noise; the field f solves Laplacian f = div v on a
grid that is one period. Both are linear, so that f given the points is Gaussian too.
With W the trilinear interpolation at the samples, K the kernel (a convolution) and A_d
the map from v_d to f, the samples see H (v, f) = (W v_1, W v_2, W v_3), and where their
places are believed too, screened, also P W f = 0 + noise, P subtracting the mean over
the samples: the surface passes through them, at one level that nobody knows. With C the
covariance of (v, f), that is K for each v_d, and f = sum_d A_d v_d,

    T = H C H^T + noise^2,    alpha = T^-1 (n_1, n_2, n_3, 0)
    mean (v, f) = C H^T alpha,    var f(x) = c(x, x) - c^T T^-1 c,  c = H C e_f(x).

Nothing is stored but fields on the grid: C is applied by Fourier transforms, T inverted
by conjugate gradients, for which its largest eigenvalues are found once. A sample of
the posterior is a sample of the prior, moved by what its errors at the points predict
(Matheron's rule). f has no mean: every field is anchored to be zero on average at the
samples.

Sellan and Jacobson (2022), "Stochastic Poisson surface reconstruction", and (2023),
"Neural stochastic screened Poisson reconstruction"; Wilson et al. (2020), "Efficiently
sampling functions from Gaussian process posteriors".
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.stats import norm
from jaxtyping import Array, Float, Int, Key

from .._core import (
    RESULTS,
    GeometryError,
    failure_where,
    first_failure,
    message,
    safe_divide,
)
from ..linear import interpolate
from ..shapes import Grid, PointCloud
from ._kernels import AbstractKernel, Matern, Spectrum
from ._measured import usable_samples
from ._observed import Observed

_POINTS_TOGETHER, _SAMPLES_TOGETHER = 8, 4
_SPACINGS = 3.0
_RTOL, _RTOL_OF_VALUES = 1e-3, 1e-5


class StochasticPoisson(eqx.Module):
    """Settings of `stochastic_poisson`.

    - `kernel`: of the vector field, `Matern(length)` or `SquaredExponential(length)`;
      by default Matern with a length of three spacings of the grid.
    - `variance`: of each component of the vector field far from the points; a third is
      that of unit vectors of any direction.
    - `noise`: standard deviation of each component of the normals.
    - `value_noise`: standard deviation of the field at the points, so of their places
      across the surface, in their unit; None: only the normals are believed.
    - `rtol`, `max_steps`: of the conjugate gradients, None: 1e-3, and 1e-5 where values
      are believed, whose systems are worse; `rank`: of their preconditioner.
    """

    kernel: AbstractKernel | None = None
    variance: Float[Array, ""] | float = 1 / 3
    noise: Float[Array, ""] | float = 0.1
    value_noise: Float[Array, ""] | float | None = None
    rtol: float | None = None
    max_steps: int = eqx.field(static=True, default=1000)
    rank: int = eqx.field(static=True, default=300)

    def __call__(self, cloud, grid, *, weights=None) -> "Posterior":
        """The posterior given an oriented cloud; see `stochastic_poisson`."""
        if cloud.normals is None:
            raise GeometryError(
                message(
                    "stochastic_poisson needs a cloud with normals",
                    "normals=None",
                    "Call jaxgeom.normals.estimate and orient_consistently first.",
                )
            )
        samples = usable_samples(cloud, grid)
        kernel = self.kernel
        if kernel is None:
            kernel = Matern(_SPACINGS * jnp.max(grid.spacing))
        weight = jnp.ones(samples.q.shape[0], samples.q.dtype)
        if weights is not None:
            # A sample of weight 0 says nothing, and is left out.
            used = samples.real & (weights > 0)
            weight = jnp.where(used, weights, 1).astype(weight.dtype)
            samples = eqx.tree_at(lambda s: s.real, samples, used)
        normals = jnp.where(samples.real[:, None], samples.normals, 0).T
        deviations, rows, rtol = [self.noise], normals, _RTOL
        if self.value_noise is not None:
            rtol = _RTOL_OF_VALUES
            deviations = [self.noise] * 3 + [self.value_noise]
            rows = jnp.concatenate([normals, jnp.zeros_like(normals[:1])])
        rtol = rtol if self.rtol is None else self.rtol
        data = Observed.of(
            Spectrum.of(kernel, self.variance, grid),
            samples.q,
            samples.real,
            weight,
            jnp.stack([d**2 / weight for d in deviations]),
            rank=self.rank,
            rtol=rtol,
            max_steps=self.max_steps,
        )
        solved = data.solve(rows)
        late = ~jnp.all(solved.residual <= rtol)
        values = data.anchored(data.fields(solved.value)[1])
        late = failure_where(late, RESULTS.not_converged)
        result = first_failure(samples.result, late)
        steps = jnp.max(solved.steps)
        return Posterior(grid, values, data, rows, solved.value, steps, result)


def stochastic_poisson(
    cloud: PointCloud,
    grid: Grid,
    *,
    weights: Float[Array, " n"] | None = None,
    **settings,
) -> "Posterior":
    """The distribution of the fields whose gradient follows the normals of a cloud.

    **Arguments:**

    - `cloud`: points with outward normals, away from the sides of the grid.
    - `grid`: one period of the field. Leave a margin of a quarter of the shape around
      it (`Grid.around(cloud, resolution=64, padding=0.5)`), and take a kernel that is
      at least two spacings long.
    - `weights`: [n], confidence: the noise of a normal has the variance noise^2 / w.
    - others: see `StochasticPoisson`. Derivatives reach all of them, and the points.

    **Statuses** (`.result`): `too_few_points`, `zero_normals`, `outside_grid`,
    `nonfinite_input` (samples ignored), `not_converged`.
    """
    return StochasticPoisson(**settings)(cloud, grid, weights=weights)


class Posterior(eqx.Module):
    """A Gaussian distribution of fields; itself the field of its mean.

    - `values`: [x, y, z] the mean at the nodes, negative inside, 0 on average at the
      samples. In the unit of the points, since the gradient follows unit normals.
    - `rows`: [3 or 4, n] what was observed, `alpha`: T^-1 of it.
    - `steps`: of the slowest linear system of the mean. `result`: see
      `stochastic_poisson`.
    """

    grid: Grid
    values: Float[Array, "x y z"]
    data: Observed
    rows: Float[Array, "r n"]
    alpha: Float[Array, "r n"]
    steps: Int[Array, ""]
    result: RESULTS

    def __call__(self, point: Float[Array, " 3"]) -> Float[Array, ""]:
        """The mean at one point."""
        return interpolate(self.values, self.grid.index_of(point)[None])[0]

    def std(self, points: Float[Array, "m 3"]) -> Float[Array, " m"]:
        """The standard deviation at points, exact up to `rtol`: three linear systems
        for each of them, or one four times as large; NaN where they did not
        converge."""
        q = self.grid.index_of(points)
        variance = self.data.level_variance
        return _root(lax.map(variance, q, batch_size=_POINTS_TOGETHER))

    def samples(self, key: Key[Array, ""], num: int) -> Float[Array, "s x y z"]:
        """Fields [num, x, y, z] drawn from the posterior, at the nodes; NaN where a
        linear system did not converge."""
        data, spectrum = self.data, self.data.spectrum

        def one(key):
            field, noise = jax.random.split(key)
            dtype = self.values.dtype
            white = jax.random.normal(field, (3, *self.grid.shape), dtype)
            error = jax.random.normal(noise, self.rows.shape, dtype)
            v = jax.vmap(spectrum.color)(white)
            f = spectrum.potential(v)
            seen = data.rows(v, f) + jnp.sqrt(data.noise) * error
            gap = jnp.where(data.real, self.rows - seen, 0)
            return data.anchored(f + data.fields(data.solved(gap))[1])

        keys = jax.random.split(key, num)
        return lax.map(one, keys, batch_size=min(num, _SAMPLES_TOGETHER))

    def normals_at(
        self, points: Float[Array, "m 3"]
    ) -> tuple[Float[Array, "m 3"], Float[Array, "m 3"]]:
        """The mean of the vector field at points, and the standard deviation of its
        components (without noise; NaN where a linear system did not converge)."""
        vectors, q = self.data.fields(self.alpha)[0], self.grid.index_of(points)
        mean = jax.vmap(lambda v: interpolate(v, q))(vectors).T
        variance = self.data.vector_variance
        return mean, _root(lax.map(variance, q, batch_size=_POINTS_TOGETHER))

    def probability_inside(self, points: Float[Array, "m 3"]) -> Float[Array, " m"]:
        """The probability that the field is negative at points."""
        mean = interpolate(self.values, self.grid.index_of(points))
        return chance_inside(mean, self.std(points))

    def surface_density(self, points: Float[Array, "m 3"]) -> Float[Array, " m"]:
        """The density of the field at 0: how likely the surface passes there, per unit
        of the field."""
        mean = interpolate(self.values, self.grid.index_of(points))
        return density_at_zero(mean, self.std(points))


def chance_inside(mean, std):
    """The probability that a Gaussian number is negative; of a sure one, 0 or 1."""
    sure = std == 0
    unsure = norm.cdf(-mean / jnp.where(sure, 1, std))
    return jnp.where(sure, (mean < 0).astype(unsure.dtype), unsure)


def density_at_zero(mean, std):
    """The density of a Gaussian number at 0; 0 for a sure one."""
    return safe_divide(norm.pdf(safe_divide(mean, std)), std)


def _root(variance):
    """The deviation; 0 with derivative 0 where rounding leaves no variance."""
    some = ~(variance <= 0)
    return jnp.where(some, jnp.sqrt(jnp.where(some, variance, 1)), 0)
