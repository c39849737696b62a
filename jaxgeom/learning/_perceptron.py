"""Layers, activations and input features: the parts of all networks."""

import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key


class AbstractActivation(eqx.Module):
    """A smooth nonlinearity, and the spread of weights that suits it."""

    @abstractmethod
    def __call__(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """The activation of every entry."""

    @abstractmethod
    def limit(self, inputs: int, first: bool) -> float:
        """Initial weights are uniform in [-limit, limit]."""


class Sine(AbstractActivation):
    """sin(frequency x): a SIREN, whose derivatives are networks of the same kind.

    `frequency` (static) bounds the detail of a shape of size 1; sparse points want less
    of it. Source: V. Sitzmann et al., Implicit neural representations with periodic
    activation functions, 2020, section 3.2.
    """

    frequency: float = eqx.field(static=True, default=15.0)

    def __call__(self, x):
        return jnp.sin(self.frequency * x)

    def limit(self, inputs, first):
        return 1 / inputs if first else math.sqrt(6 / inputs) / self.frequency


class Softplus(AbstractActivation):
    """log(1 + exp(sharpness x)) / sharpness: a ramp with a rounded corner.

    Source: A. Gropp et al., Implicit geometric regularization, 2020, section 4.
    """

    sharpness: float = eqx.field(static=True, default=10.0)

    def __call__(self, x):
        return jax.nn.softplus(self.sharpness * x) / self.sharpness

    def limit(self, inputs, first):
        return math.sqrt(6 / inputs)


class Dense(eqx.Module):
    """weight x + bias."""

    weight: Float[Array, "o i"]
    bias: Float[Array, " o"]

    def __call__(self, x: Float[Array, " i"]) -> Float[Array, " o"]:
        """The affine image of one vector."""
        return self.weight @ x + self.bias


class Perceptron(eqx.Module):
    """A multilayer perceptron: vector to vector, no activation after the last layer."""

    layers: tuple[Dense, ...]
    activation: AbstractActivation

    def __call__(self, x: Float[Array, " i"]) -> Float[Array, " o"]:
        """The output for one vector."""
        for layer in self.layers[:-1]:
            x = self.activation(layer(x))
        return self.layers[-1](x)


def perceptron(
    sizes: tuple[int, ...], activation: AbstractActivation, *, key: Key[Array, ""]
) -> Perceptron:
    """A perceptron with the layer widths `sizes`, whose output is zero at first.

    Hidden weights are uniform as the activation wants them, hidden biases uniform in
    1 / sqrt(inputs). The last layer starts at zero: what the network is added to (a
    sphere, see `NeuralField`) is where training begins.
    """
    keys = jax.random.split(key, len(sizes) - 1)
    pairs = list(zip(sizes[:-1], sizes[1:], strict=True))
    hidden = [
        _dense(i, o, activation.limit(i, n == 0), keys[n])
        for n, (i, o) in enumerate(pairs[:-1])
    ]
    i, o = pairs[-1]
    last = Dense(jnp.zeros((o, i)), jnp.zeros(o))
    return Perceptron((*hidden, last), activation)


def spread_perceptron(
    sizes: tuple[int, ...], activation: AbstractActivation, *, key: Key[Array, ""]
) -> Perceptron:
    """As `perceptron`, but with random weights in the last layer, too."""
    key, last = jax.random.split(key)
    body = perceptron(sizes, activation, key=key)
    i, o = sizes[-2:]
    ends = _dense(i, o, activation.limit(i, False), last)
    return Perceptron((*body.layers[:-1], ends), activation)


def _dense(inputs, outputs, limit, key):
    key_weight, key_bias = jax.random.split(key)
    uniform = lambda k, shape, a: jax.random.uniform(k, shape, minval=-a, maxval=a)
    return Dense(
        uniform(key_weight, (outputs, inputs), limit),
        uniform(key_bias, (outputs,), 1 / math.sqrt(inputs)),
    )


class AbstractFeatures(eqx.Module):
    """What a network sees of a point."""

    @abstractmethod
    def __call__(self, point: Float[Array, " 3"]) -> Float[Array, " i"]:
        """The features of one point."""

    @abstractmethod
    def size(self) -> int:
        """The number of features."""


class Coordinates(AbstractFeatures):
    """The point itself."""

    def __call__(self, point):
        return point

    def size(self):
        return 3


class FourierFeatures(AbstractFeatures):
    """x, sin(2 pi B x), cos(2 pi B x) with fixed frequencies B [m, 3].

    Source: M. Tancik et al., Fourier features let networks learn high frequency
    functions, 2020.
    """

    frequencies: Float[Array, "m 3"]

    @staticmethod
    def random(num: int, *, bandwidth: float, key: Key[Array, ""]) -> "FourierFeatures":
        """`num` normal frequencies of standard deviation `bandwidth` (per unit)."""
        return FourierFeatures(bandwidth * jax.random.normal(key, (num, 3)))

    def __call__(self, point):
        # The frequencies are chosen, not learned.
        phase = 2 * jnp.pi * jax.lax.stop_gradient(self.frequencies) @ point
        return jnp.concatenate([point, jnp.sin(phase), jnp.cos(phase)])

    def size(self):
        return 3 + 2 * self.frequencies.shape[0]
