"""Stochastic Poisson reconstruction: all fields that oriented points allow.

The vector field v whose values at the samples are their normals is a Gaussian process,
each component alone, n_p = v(x_p) + noise; the field f solves Laplacian f = div v on a
grid that is one period. Both are linear, so that f given the points is Gaussian too.
With W the trilinear interpolation at the samples, K the kernel (a convolution),
T = W K W^T + noise^2, and A_d the map from v_d to f,

    alpha_d = T^-1 n_d,    mean f = sum_d A_d K W^T alpha_d
    var f(x) = k_f(0) - sum_d c_d^T T^-1 c_d,    c_d = Cov(v_d(X), f(x)).

Nothing is stored but fields on the grid: K is applied by Fourier transforms, T inverted
by conjugate gradients. A sample of the posterior is a sample of the prior, moved by
what its errors at the points predict (Matheron's rule). f has no mean: every field is
anchored to be zero on average at the samples.

Sellan and Jacobson (2022), "Stochastic Poisson surface reconstruction"; Wilson et al.
(2020), "Efficiently sampling functions from Gaussian process posteriors".
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float, Int, Key

from .._core import RESULTS, GeometryError, first_failure, message, safe_divide
from ..linear import conjugate_gradients, interpolate, splat
from ..shapes import Grid, PointCloud
from ._kernels import AbstractKernel, Matern, Spectrum
from ._measured import usable_samples

_POINTS_TOGETHER, _SAMPLES_TOGETHER = 8, 4
_SPACINGS = 3.0


class StochasticPoisson(eqx.Module):
    """Settings of `stochastic_poisson`.

    - `kernel`: of the vector field, `Matern(length)` or `SquaredExponential(length)`;
      by default Matern with a length of three spacings of the grid.
    - `variance`: of each component of the vector field far from the points; a third is
      that of unit vectors of any direction.
    - `noise`: standard deviation of each component of the normals.
    - `rtol`, `max_steps`: of the conjugate gradients.
    """

    kernel: AbstractKernel | None = None
    variance: Float[Array, ""] | float = 1 / 3
    noise: Float[Array, ""] | float = 0.1
    rtol: float = 1e-3
    max_steps: int = eqx.field(static=True, default=300)

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
        noise = jnp.full(samples.q.shape[0], self.noise, samples.q.dtype) ** 2
        if weights is not None:
            # A sample of weight 0 says nothing, and is left out.
            noise = noise / jnp.where(weights > 0, weights, 1)
            used = samples.real & (weights > 0)
            samples = eqx.tree_at(lambda s: s.real, samples, used)
        data = _Data(
            Spectrum.of(kernel, self.variance, grid),
            samples.q,
            samples.real,
            noise,
            self.rtol,
            self.max_steps,
        )
        normals = jnp.where(samples.real[:, None], samples.normals, 0)
        solved = jax.vmap(data.solve, in_axes=1)(normals)
        ended = jnp.all(solved.residual <= self.rtol)
        status = RESULTS.where(ended, RESULTS.successful, RESULTS.not_converged)
        values = data.anchored(data.field_of(solved.value))
        result = first_failure(samples.result, status)
        steps = jnp.max(solved.steps)
        return Posterior(grid, values, data, normals, solved.value, steps, result)


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


class _Data(eqx.Module):
    """What was observed where, and the prior: all linear maps of the model."""

    spectrum: Spectrum
    q: Float[Array, "n 3"]
    real: Bool[Array, " n"]
    noise: Float[Array, " n"]
    rtol: float
    max_steps: int = eqx.field(static=True)

    def at(self, values):
        """Values at the samples, zero for padding."""
        return jnp.where(self.real, interpolate(values, self.q), 0)

    def spread(self, x):
        """The transpose of `at`."""
        return splat(jnp.where(self.real, x, 0), self.q, self.spectrum.shape)

    def solve(self, b):
        """T^-1 b."""
        apply = lambda x: self.at(self.spectrum.smooth(self.spread(x))) + self.noise * x
        # One over the diagonal of T, but for the interpolation.
        scale = 1 / (self.spectrum.variance + self.noise)
        return conjugate_gradients(
            apply,
            b,
            rtol=self.rtol,
            max_steps=self.max_steps,
            preconditioner=lambda r: scale * r,
        )

    def solved(self, rows):
        """T^-1 of every row; NaN where the residual is above the tolerance."""
        out = jax.vmap(self.solve)(rows)
        good = (out.residual <= self.rtol)[:, None]
        return jnp.where(good, out.value, jnp.nan)

    def field_of(self, alpha):
        """The field [x, y, z] of the coefficients alpha [3, n]."""
        return self.spectrum.field_from(jax.vmap(self.spread)(alpha))

    def anchored(self, values):
        """Less the mean at the samples."""
        return values - safe_divide(jnp.sum(self.at(values)), jnp.sum(self.real))

    def looking_at(self, q):
        """The source whose product with a field is its anchored value at q."""
        count = jnp.maximum(jnp.sum(self.real), 1).astype(self.q.dtype)
        anchor = self.spread(jnp.ones_like(self.noise) / count)
        return splat(jnp.ones(1, self.q.dtype), q[None], self.spectrum.shape) - anchor


class Posterior(eqx.Module):
    """A Gaussian distribution of fields; itself the field of its mean.

    - `values`: [x, y, z] the mean at the nodes, negative inside, 0 on average at the
      samples. In the unit of the points, since the gradient follows unit normals.
    - `steps`: of the slowest linear system of the mean. `result`: see
      `stochastic_poisson`.
    """

    grid: Grid
    values: Float[Array, "x y z"]
    data: _Data
    normals: Float[Array, "n 3"]
    alpha: Float[Array, "3 n"]
    steps: Int[Array, ""]
    result: RESULTS

    def __call__(self, point: Float[Array, " 3"]) -> Float[Array, ""]:
        """The mean at one point."""
        return interpolate(self.values, self.grid.index_of(point)[None])[0]

    def std(self, points: Float[Array, "m 3"]) -> Float[Array, " m"]:
        """The standard deviation at points, exact up to `rtol`: three linear systems
        for each of them; NaN where they did not converge."""
        data = self.data

        def variance(q):
            source = data.looking_at(q)
            seen = jax.vmap(data.at)(data.spectrum.vectors_from(source))
            known = jnp.sum(seen * data.solved(seen))
            return data.spectrum.variance_of(source) - known

        q = self.grid.index_of(points)
        return _root(lax.map(variance, q, batch_size=_POINTS_TOGETHER))

    def samples(self, key: Key[Array, ""], num: int) -> Float[Array, "s x y z"]:
        """Fields [num, x, y, z] drawn from the posterior, at the nodes; NaN where a
        linear system did not converge."""
        data, shape = self.data, self.grid.shape

        def one(key):
            field, noise = jax.random.split(key)
            dtype = self.values.dtype
            white = jax.random.normal(field, (3, *shape), dtype)
            error = jax.random.normal(noise, self.normals.shape, dtype)
            v = jax.vmap(data.spectrum.color)(white)
            seen = jax.vmap(data.at)(v).T + jnp.sqrt(data.noise)[:, None] * error
            gap = jnp.where(data.real[:, None], self.normals - seen, 0)
            alpha = data.solved(gap.T)
            return data.anchored(data.spectrum.potential(v) + data.field_of(alpha))

        keys = jax.random.split(key, num)
        return lax.map(one, keys, batch_size=min(num, _SAMPLES_TOGETHER))

    def normals_at(
        self, points: Float[Array, "m 3"]
    ) -> tuple[Float[Array, "m 3"], Float[Array, " m"]]:
        """The mean of the vector field at points, and the standard deviation of each of
        its components (without noise; NaN where a linear system did not converge)."""
        data, spectrum = self.data, self.data.spectrum
        vectors = jax.vmap(lambda a: spectrum.smooth(data.spread(a)))(self.alpha)
        q = self.grid.index_of(points)
        mean = jax.vmap(lambda v: interpolate(v, q))(vectors).T

        def variance(q):
            source = splat(jnp.ones(1, q.dtype), q[None], spectrum.shape)
            smooth = spectrum.smooth(source)
            seen = data.at(smooth)
            return jnp.vdot(source, smooth) - jnp.vdot(seen, data.solved(seen[None])[0])

        return mean, _root(lax.map(variance, q, batch_size=3 * _POINTS_TOGETHER))

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
