"""Networks that are fields: of one shape, and of a family of shapes by a code."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from ..fields import AbstractField, Claims
from ._perceptron import (
    AbstractFeatures,
    Coordinates,
    FourierFeatures,
    Perceptron,
    Sine,
    Softplus,
    perceptron,
)


class NeuralField(AbstractField):
    """f(x) = sqrt(|x|^2 + c^2) - sqrt(r^2 + c^2) + network(features(x)), c = r / 2.

    Before training the network is zero, and the surface the sphere of `radius` r: an
    outside and an inside are there from the start. Implicit only: training makes it
    nearly a distance, nothing proves it. Coordinates are best within [-1/2, 1/2], to
    which `fit_field` brings every cloud.

    Made by `NeuralField.fourier` and `NeuralField.siren`.

    Source: M. Atzmon, Y. Lipman, SAL, 2020 (the sphere as a start).
    """

    features: AbstractFeatures
    network: Perceptron
    radius: Float[Array, ""]

    @staticmethod
    def fourier(
        *,
        key: Key[Array, ""],
        width: int = 64,
        depth: int = 3,
        num_frequencies: int = 32,
        bandwidth: float = 0.5,
        radius: float = 0.35,
    ) -> "NeuralField":
        """`depth` hidden layers of `width` softplus units on Fourier features.

        `bandwidth`: standard deviation of the frequencies, in waves per unit.
        """
        features = (num_frequencies, bandwidth)
        parts = _on_fourier_features(0, features, [width] * depth, key)
        return NeuralField(*parts, jnp.asarray(radius, float))

    @staticmethod
    def siren(
        *,
        key: Key[Array, ""],
        width: int = 64,
        depth: int = 3,
        frequency: float = 15.0,
        radius: float = 0.35,
    ) -> "NeuralField":
        """`depth` hidden layers of `width` sine units (see `Sine`)."""
        network = perceptron((3, *[width] * depth, 1), Sine(frequency), key=key)
        return NeuralField(Coordinates(), network, jnp.asarray(radius, float))

    def evaluate(self, point):
        return sphere_start(point, self.radius) + self.network(self.features(point))[0]

    def claims(self):
        return Claims.unknown()


class Decoder(eqx.Module):
    """A family of fields: network(code, features(x)) added to a sphere.

    `decoder.field(code)` is one member. Made by `Decoder.create`.

    Source: J. J. Park et al., DeepSDF, 2019.
    """

    features: AbstractFeatures
    network: Perceptron
    radius: Float[Array, ""]
    code_size: int = eqx.field(static=True)

    @staticmethod
    def create(
        code_size: int,
        *,
        key: Key[Array, ""],
        width: int = 96,
        depth: int = 3,
        num_frequencies: int = 32,
        bandwidth: float = 0.5,
        radius: float = 0.35,
    ) -> "Decoder":
        """`depth` hidden layers of `width` softplus units on code and features."""
        features = (num_frequencies, bandwidth)
        parts = _on_fourier_features(code_size, features, [width] * depth, key)
        return Decoder(*parts, jnp.asarray(radius, float), code_size)

    def __call__(
        self, code: Float[Array, " c"], point: Float[Array, " 3"]
    ) -> Float[Array, ""]:
        """The value at one point of the member with this code."""
        seen = jnp.concatenate([code, self.features(point)])
        return sphere_start(point, self.radius) + self.network(seen)[0]

    def field(self, code: Float[Array, " c"]) -> "LatentField":
        """The member of the family with this code."""
        return LatentField(self, code)


class LatentField(AbstractField):
    """One member of the family of a `Decoder`. Implicit only."""

    decoder: Decoder
    code: Float[Array, " c"]

    def evaluate(self, point):
        return self.decoder(self.code, point)

    def claims(self):
        return Claims.unknown()


class Unsigned(AbstractField):
    """|f(x)|: the distance to a surface that may be open. No sign, no inside.

    Implicit only. Trained on unsigned distances (see `unsigned_samples`).

    Source: J. Chibane et al., Neural unsigned distance fields, 2020.
    """

    body: AbstractField

    def evaluate(self, point):
        return jnp.abs(self.body(point))

    def claims(self):
        return Claims.unknown()


def _on_fourier_features(num_more, frequencies, widths, key):
    """Fourier features, and a perceptron that reads them after `num_more` numbers."""
    key_features, key_network = jax.random.split(key)
    number, bandwidth = frequencies
    features = FourierFeatures.random(number, bandwidth=bandwidth, key=key_features)
    sizes = (num_more + features.size(), *widths, 1)
    return features, perceptron(sizes, Softplus(), key=key_network)


def sphere_start(point, radius):
    """A field of the sphere of `radius` that is smooth at the center."""
    c = radius / 2
    rounded = lambda square: jnp.sqrt(square + c * c)
    return rounded(jnp.dot(point, point)) - rounded(radius * radius)
