"""Stationary covariances by their spectra on a periodic grid."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, message
from ..shapes import Grid


class AbstractKernel(eqx.Module):
    """A covariance k(x - x') that depends on the distance only."""

    @abstractmethod
    def spectrum(self, square: Float[Array, "..."]) -> Float[Array, "..."]:
        """Its Fourier transform, up to a factor, at squared angular frequencies."""

    @abstractmethod
    def covariance(self, square: Float[Array, "..."]) -> Float[Array, "..."]:
        """k at squared distances, 1 at zero."""


class SquaredExponential(AbstractKernel):
    """k(r) = exp(-r^2 / (2 length^2)), of spectrum exp(-length^2 |k|^2 / 2).

    `length`: in the unit of the points.
    """

    length: Float[Array, ""] | float

    def spectrum(self, square):
        return jnp.exp(-square * self.length**2 / 2)

    def covariance(self, square):
        return jnp.exp(-square / (2 * self.length**2))


class Matern(AbstractKernel):
    """The covariance of Matern with smoothness nu, of spectrum
    (2 nu / length^2 + |k|^2)^-(nu + 3/2).

    `length`: in the unit of the points; `smoothness`: nu, 3/2 for fields with one
    derivative. Rasmussen and Williams (2006), "Gaussian processes for machine
    learning", equation 4.15.
    """

    length: Float[Array, ""] | float
    smoothness: float = 1.5

    def spectrum(self, square):
        nu = self.smoothness
        # Divided by the constant term, so that a long length does not underflow.
        return (1 + square * self.length**2 / (2 * nu)) ** -(nu + 1.5)

    def covariance(self, square):
        """In closed form for a smoothness of 1/2, 3/2 or 5/2, else `GeometryError`."""
        if self.smoothness not in (0.5, 1.5, 2.5):
            raise GeometryError(
                message(
                    "only a smoothness of 0.5, 1.5 or 2.5 has a covariance in closed "
                    "form",
                    f"{self.smoothness}",
                    "Use one of these, or stochastic_poisson, which needs no form.",
                )
            )
        some = square > 0
        root = jnp.where(some, jnp.sqrt(jnp.where(some, square, 1)), 0)
        r = (2 * self.smoothness) ** 0.5 * root / self.length
        tail = {0.5: 1.0, 1.5: 1 + r, 2.5: 1 + r + r**2 / 3}[self.smoothness]
        return tail * jnp.exp(-r)


class Spectrum(eqx.Module):
    """A kernel of variance `variance` on a grid that is one period, by frequencies.

    - `power`: [x, y, z // 2 + 1] rho, with k(x) = sum_k rho(k) exp(i k x).
    - `ascent`: [3, ...] k_d / |k|^2, zero at k = 0: f = div^-1 of a vector field v has
      the transform -i sum_d ascent_d v_d.
    """

    power: Float[Array, "x y m"]
    variance: Float[Array, ""]
    ascent: Float[Array, "3 x y m"]
    shape: tuple[int, int, int] = eqx.field(static=True)

    @staticmethod
    def of(kernel: AbstractKernel, variance, grid: Grid) -> "Spectrum":
        """The spectrum on a grid, scaled so that k(0) is the variance."""
        shape, half = grid.shape, grid.shape[2] // 2 + 1
        axes, odd = [], []
        for d, n in enumerate(shape):
            number = np.fft.fftfreq(n, 1 / n)
            line = [-1 if d == e else 1 for e in range(3)]
            k = 2 * np.pi * jnp.asarray(number, grid.spacing.dtype)
            axes.append((k / (n * grid.spacing[d])).reshape(line))
            # The highest frequency of an even grid has no sine: no odd derivative.
            has_sine = (2 * np.abs(number) != n).reshape(line)
            odd.append(jnp.where(has_sine, axes[d], 0))
        square = sum(k**2 for k in axes)
        power = kernel.spectrum(square)
        power = variance * power / jnp.sum(power)
        inverse = jnp.where(square > 0, 1 / jnp.where(square > 0, square, 1), 0)
        ascent = jnp.stack([jnp.broadcast_to(k * inverse, shape) for k in odd])
        variance = jnp.asarray(variance, power.dtype)
        return Spectrum(power[..., :half], variance, ascent[..., :half], shape)

    def smooth(self, x: Float[Array, "x y z"]) -> Float[Array, "x y z"]:
        """K x: the convolution with the kernel."""
        return self.back(self._size() * self.power * jnp.fft.rfftn(x))

    def color(self, white: Float[Array, "x y z"]) -> Float[Array, "x y z"]:
        """A field with this covariance, from one without."""
        return self.back(jnp.sqrt(self._size() * self.power) * jnp.fft.rfftn(white))

    def potential(self, v: Float[Array, "3 x y z"]) -> Float[Array, "x y z"]:
        """f with Laplacian f = div v and mean 0."""
        return self._field(jnp.fft.rfftn(v, axes=(1, 2, 3)))

    def field_from(self, sources: Float[Array, "3 x y z"]) -> Float[Array, "x y z"]:
        """Cov(f, v) sources."""
        return self._field(self._spectra(sources))

    def vectors_from(self, source: Float[Array, "x y z"]) -> Float[Array, "3 x y z"]:
        """Cov(v, f) source, the transpose of `field_from`."""
        spectrum = self._size() * self.power * jnp.fft.rfftn(source)
        return jnp.stack([self.back(1j * a * spectrum) for a in self.ascent])

    def both_from(
        self, sources: Float[Array, "3 x y z"], source: Float[Array, "x y z"]
    ) -> tuple[Float[Array, "3 x y z"], Float[Array, "x y z"]]:
        """Cov((v, f), (v, f)) of sources of v and one of f."""
        pull = 1j * self._size() * self.power * jnp.fft.rfftn(source)
        spectra = self._spectra(sources) + self.ascent * pull
        v = jnp.fft.irfftn(spectra, s=self.shape, axes=(1, 2, 3))
        return v, self._field(spectra)

    def levels_from(self, source: Float[Array, "x y z"]) -> Float[Array, "x y z"]:
        """Cov(f, f) source."""
        power = self._size() * self.power * jnp.sum(self.ascent**2, axis=0)
        return self.back(power * jnp.fft.rfftn(source))

    def back(self, spectrum):
        """The values of a transform."""
        return jnp.fft.irfftn(spectrum, s=self.shape)

    def _spectra(self, sources):
        return self._size() * self.power * jnp.fft.rfftn(sources, axes=(1, 2, 3))

    def _field(self, spectra):
        return self.back(-1j * jnp.sum(self.ascent * spectra, axis=0))

    def _size(self):
        x, y, z = self.shape
        return x * y * z
