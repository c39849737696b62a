"""The posterior over fields as two networks: neural stochastic screened Poisson.

The vector field V whose values at the samples are their normals is the Gaussian process
of `stochastic_poisson`: its posterior has, for each component alone,

    m(x) = k(x, X) T^-1 n,    s(x, x') = k(x, x') - k(x, X) T^-1 k(X, x'),

T = k(X, X) + noise^2. The field f whose gradient is nearest to V (the variational form
of Poisson's equation) depends on V linearly, and so is Gaussian; its mean mu and its
covariance phi(x) . phi(x'), phi a network from space to r numbers, are those with the
least

    E_x |grad mu - m|^2                 + screening mean_p mu(p)^2,
    E_x,x' |J(x) J(x')^T - s(x, x') I|^2 / v^2  + screening mean_p |phi(p)|^2 / v,

x and x' uniform in a box, p the samples, J the Jacobian of phi, v the variance of the
prior: J J'^T is the covariance of grad f, and its distance to that of V in the norm of
Hilbert and Schmidt is least for the orthogonal projection of V onto gradients. Both
losses leave a constant free, which the screening chooses: f is zero on average at the
samples. A sample of f is mu + phi . z with z normal.

After S. Sellan, A. Jacobson, Neural stochastic screened Poisson reconstruction, 2023.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from .._core import (
    RESULTS,
    GeometryError,
    failure_where,
    first_failure,
    message,
    safe_divide,
    safe_norm,
)
from ..fields import AbstractField, Claims
from ..learning import (
    AbstractFeatures,
    Adam,
    FourierFeatures,
    NeuralField,
    Perceptron,
    Softplus,
    spread_perceptron,
    train,
)
from ..reconstruction import AbstractKernel, Matern
from ..reconstruction._stochastic import chance_inside, density_at_zero
from ..shapes import PointCloud
from ..transforms import Similarity
from ._fit_field import bare, check_trained, user_from_unit
from ._prepare import padded, unit_box
from ._vector_process import MeanLoss, SpreadLoss, Vectors

_MOST_POINTS = 8192
_LENGTH = 0.2
_SMALL = 0.005
_LEAST_SHARE = 0.1


class Spread(eqx.Module):
    """phi: a point of the unit box to r numbers, whose products are covariances."""

    features: AbstractFeatures
    network: Perceptron

    @staticmethod
    def fourier(
        rank: int,
        *,
        key: Key[Array, ""],
        width: int = 96,
        depth: int = 2,
        num_frequencies: int = 96,
        bandwidth: float = 0.8,
    ) -> "Spread":
        """`depth` hidden layers of `width` softplus units on Fourier features.

        Its numbers are small at first: the loss grows with their fourth power.
        """
        key_features, key_network = jax.random.split(key)
        features = FourierFeatures.random(
            num_frequencies, bandwidth=bandwidth, key=key_features
        )
        sizes = (features.size(), *[width] * depth, rank)
        network = spread_perceptron(sizes, Softplus(), key=key_network)
        last = lambda n: n.layers[-1]
        small = jax.tree.map(lambda x: _SMALL * x, last(network))
        return Spread(features, eqx.tree_at(last, network, small))

    def __call__(self, point: Float[Array, " 3"]) -> Float[Array, " r"]:
        """The numbers of one point."""
        return self.network(self.features(point))


class NeuralPosterior(AbstractField):
    """A Gaussian distribution of fields; itself the field of its mean.

    Points are in the unit and the place of the scan, values in its unit (gradients
    follow unit normals), negative inside, zero on average at the samples.

    - `mean`, `spread`: the networks, in the unit box; `user_from_unit`: where that is.
    - `mean_there`, `spread_there` [r]: what is taken off both, their means at the
      samples.
    - `explained`: the share of the squared covariance of V that J J'^T took off, about
      a third where all gradients are there (V has more than gradients).
    - `losses`: of both trainings. `result`, `notes`: what happened.
    """

    mean: AbstractField
    spread: Spread
    mean_there: Float[Array, ""]
    spread_there: Float[Array, " r"]
    user_from_unit: Similarity
    explained: Float[Array, ""]
    losses: tuple[Float[Array, " s"], Float[Array, " s"]]
    result: RESULTS
    notes: tuple[str, ...] = eqx.field(static=True, default=())

    def evaluate(self, point):
        return self._size * (self.mean(self._inside(point)) - self.mean_there)

    def claims(self):
        return Claims.unknown()

    def factor(self, points: Float[Array, "m 3"]) -> Float[Array, "m r"]:
        """The rows phi(x): the covariance of the values at points is F F^T."""
        rows = jax.vmap(lambda x: self.spread(self._inside(x)))(points)
        return self._size * (rows - self.spread_there)

    def std(self, points: Float[Array, "m 3"]) -> Float[Array, " m"]:
        """The standard deviation at points."""
        return safe_norm(self.factor(points))

    def draw(self, key: Key[Array, ""]) -> "DrawnField":
        """One field of the distribution."""
        there = self.spread_there
        return DrawnField(self, jax.random.normal(key, there.shape, there.dtype))

    def probability_inside(self, points: Float[Array, "m 3"]) -> Float[Array, " m"]:
        """The probability that the field is negative at points."""
        return chance_inside(jax.vmap(self)(points), self.std(points))

    def surface_density(self, points: Float[Array, "m 3"]) -> Float[Array, " m"]:
        """The density of the field at 0: how likely the surface passes there, per unit
        of the field."""
        return density_at_zero(jax.vmap(self)(points), self.std(points))

    @property
    def _size(self):
        return self.user_from_unit.scale

    def _inside(self, point):
        return self.user_from_unit.inverse().points(point)


class DrawnField(AbstractField):
    """mu + phi . z: a field drawn from a `NeuralPosterior`."""

    posterior: NeuralPosterior
    z: Float[Array, " r"]

    def evaluate(self, point):
        return self.posterior(point) + self.posterior.factor(point[None])[0] @ self.z

    def claims(self):
        return Claims.unknown()


def neural_posterior(
    cloud: PointCloud,
    *,
    key: Key[Array, ""],
    kernel: AbstractKernel | None = None,
    variance: float = 1 / 3,
    noise: float = 0.1,
    screening: float = 0.1,
    rank: int = 96,
    padding: float = 0.5,
    num_places: int = 4096,
    adam: Adam | None = None,
    progress: Callable[[int, float], None] | None = None,
    throw: bool = True,
) -> NeuralPosterior:
    """The distribution of the fields whose gradient follows the normals of a cloud, as
    two networks (host form): mean and deviation anywhere, drawn fields that can be
    meshed and differentiated, without a grid.

    **Arguments:**

    - `cloud`: at most 8 192 points with normals, in any unit: a matrix of all pairs is
      factorized once. See `shapes.subsample`.
    - `key`: a typed key, used once: same key, same networks.
    - `kernel`: of the vector field, `Matern(length)` or `SquaredExponential(length)`,
      its length in the unit of the points; a fifth of the longest side by default.
      Half of it needs eight times the rank.
    - `variance`, `noise`: of each component of the vectors, and the standard deviation
      of those of the normals; see `StochasticPoisson`.
    - `screening`: the pull to zero at the samples. As good as none (0.01) gives the
      distribution of `stochastic_poisson`; more makes the samples sure of the surface.
    - `rank`: how many numbers make up the covariance: r independent fields.
    - `padding`: the box is 1 + padding times as wide as the scan; outside of it the
      networks mean nothing.
    - `num_places`: random places in the box where the vectors are known to training.
    - `adam`: `Adam(rate=1e-3)` by default, for each of the two; a larger rate may leave
      the deviations too small.
    - `progress`: called as progress(steps done, loss) after every 100 steps.
    - `throw`: raise `GeometryError` where training diverged.

    **Statuses:** `diverged`; `not_converged` (of one of the networks, or less than 0.1
    of the covariance explained: take more rank, steps or length). Raises
    `GeometryError` for the clouds that `prepare` refuses, for clouds without normals or
    with too many points.
    """
    ready = unit_box(cloud)
    _check(ready.cloud, rank)
    kernel = Matern(_LENGTH * ready.scale) if kernel is None else kernel
    length = jnp.asarray(kernel.length / ready.scale)
    kernel = eqx.tree_at(lambda k: k.length, kernel, length)
    unit = padded(bare(ready))
    dtype = unit.points.dtype
    keys = jax.random.split(key, 6)
    reach = (1 + padding) / 2
    places = jax.random.uniform(keys[0], (num_places, 3), dtype, -reach, reach)
    variance, noise, pull = (
        jnp.asarray(x, dtype) for x in (variance, noise, screening)
    )
    data = _vectors(unit, places, kernel, variance, noise)
    settings = {"adam": Adam(rate=1e-3) if adam is None else adam, "progress": progress}
    # Waves per unit, as the kernel has them.
    band = {"bandwidth": 1 / (2 * math.pi * float(length))}
    mean = NeuralField.fourier(key=keys[1], num_frequencies=64, **band)
    spread = Spread.fourier(rank, key=keys[2], **band)
    trained = (
        train(mean, MeanLoss(pull), data, key=keys[3], **settings),
        train(spread, SpreadLoss(pull), data, key=keys[4], **settings),
    )
    for out in trained if throw else ():
        check_trained(out)
    share = _explained(trained[1].model, data, keys[5])
    missed = failure_where(~(share >= _LEAST_SHARE), RESULTS.not_converged)
    models = [out.model for out in trained]
    return NeuralPosterior(
        *models,
        *_at_samples(*models, data),
        user_from_unit(ready),
        share,
        tuple(out.losses for out in trained),
        first_failure(*(out.result for out in trained), missed),
        ready.notes,
    )


_vectors = eqx.filter_jit(Vectors.of)


@eqx.filter_jit
def _explained(spread, data, key):
    """The share of the squared covariance that the model explains, of many pairs."""
    fit = lambda k: SpreadLoss(jnp.zeros(())).fit(spread, data, k)
    left, nothing = jax.lax.map(fit, jax.random.split(key, 16))
    return 1 - safe_divide(jnp.sum(left), jnp.sum(nothing))


@eqx.filter_jit
def _at_samples(mean, spread, data):
    """The means of both networks over the samples."""
    weights = data.real.astype(data.points.dtype)
    weights = weights / jnp.maximum(jnp.sum(weights), 1)
    average = lambda f: weights @ jax.vmap(f)(data.points)
    return average(mean), average(spread)


def _check(cloud, rank):
    if cloud.normals is None:
        raise GeometryError(
            message(
                "neural_posterior needs a cloud with normals",
                "normals=None",
                "Call jaxgeom.normals.estimate and orient_consistently first.",
            )
        )
    if len(cloud.points) > _MOST_POINTS or rank < 1:
        raise GeometryError(
            message(
                f"there may be at most {_MOST_POINTS} points, and a rank of at least 1",
                f"{len(cloud.points)} points, rank {rank}",
                "Draw fewer with shapes.subsample, or use stochastic_poisson.",
            )
        )
