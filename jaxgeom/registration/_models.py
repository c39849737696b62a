"""Which transforms are allowed: kinds, locked directions, and a prior on the pose."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_normalize, tangents_to
from ..transforms import Affine, Rigid, Similarity


class GaussianPrior(eqx.Module):
    """Where the answer is expected, with which covariance.

    Adds noise^2 e^T C^-1 e to the cost, e the tangent vector from `mean` to the
    transform.

    - `mean`: target_from_source, of the kind of the model.
    - `covariance`: C [dof, dof] of e: rotation vector in radians, then translation.
    - `noise`: the standard deviation of one residual, in the unit of the points.
    """

    mean: Rigid | Similarity | Affine
    covariance: Float[Array, "dof dof"]
    noise: Float[Array, ""] | float


class AbstractModel(eqx.Module):
    """A kind of transform with its tangent space.

    Steps are exp(xi) T, xi = basis z: without a `basis` [dof, k] every direction is
    free. Tangent vectors are about the origin of the target.
    """

    basis: eqx.AbstractVar[Float[Array, "dof k"] | None]
    prior: eqx.AbstractVar[GaussianPrior | None]

    @property
    @abstractmethod
    def dof(self) -> int:
        """The size of a tangent vector."""

    @abstractmethod
    def exp(self, xi: Float[Array, " dof"]):
        """The transform of a tangent vector."""

    @abstractmethod
    def generator(self, xi: Float[Array, " dof"]):
        """G [3, 3] and v [3]: near zero exp(xi) moves x to x + G x + v."""

    @abstractmethod
    def cast(self, transform):
        """The transform as one of this kind."""

    @abstractmethod
    def difference(self, a, b) -> Float[Array, " dof"]:
        """The tangent vector from b to a."""


class RigidModel(AbstractModel):
    """Turns and shifts: xi = (rotation vector, velocity), [6]."""

    basis: Float[Array, "6 k"] | None = None
    prior: GaussianPrior | None = None

    @property
    def dof(self):
        return 6

    def exp(self, xi):
        return Rigid.exp(xi)

    def generator(self, xi):
        return _cross_matrix(xi[:3]), xi[3:]

    def cast(self, transform):
        return Rigid(transform.rotation, transform.translation)

    def difference(self, a, b):
        return (a @ b.inverse()).log()


class SimilarityModel(AbstractModel):
    """Turns, shifts and one scale: xi = (rotation vector, velocity, log scale), [7]."""

    basis: Float[Array, "7 k"] | None = None
    prior: GaussianPrior | None = None

    @property
    def dof(self):
        return 7

    def exp(self, xi):
        return Similarity.exp(xi)

    def generator(self, xi):
        eye = jnp.eye(3, dtype=xi.dtype)
        return _cross_matrix(xi[:3]) + xi[6] * eye, xi[3:6]

    def cast(self, transform):
        if isinstance(transform, Similarity):
            return transform
        one = jnp.ones((), transform.translation.dtype)
        return Similarity(one, transform.rotation, transform.translation)

    def difference(self, a, b):
        return (a @ b.inverse()).log()


class AffineModel(AbstractModel):
    """Any matrix and shift: xi = (matrix by rows, velocity), [12]."""

    basis: Float[Array, "12 k"] | None = None
    prior: GaussianPrior | None = None

    @property
    def dof(self):
        return 12

    def exp(self, xi):
        return Affine.exp(xi)

    def generator(self, xi):
        return xi[:9].reshape(3, 3), xi[9:]

    def cast(self, transform):
        return Affine.of(transform)

    def difference(self, a, b):
        # Affine maps have no logarithm under jit; near each other this is its start.
        change = a @ b.inverse()
        linear = change.coefficients - jnp.eye(3, dtype=change.translation.dtype)
        return jnp.concatenate([linear.reshape(-1), change.translation])


def yaw(axis: Float[Array, " 3"]) -> Float[Array, "6 4"]:
    """The basis of turns about the direction `axis` and all shifts."""
    turn = jnp.concatenate([_unit(axis), jnp.zeros(3)])
    shifts = jnp.concatenate([jnp.zeros((3, 3)), jnp.eye(3)])
    return jnp.concatenate([turn[:, None], shifts], axis=1)


def planar(normal: Float[Array, " 3"]) -> Float[Array, "6 3"]:
    """The basis of motions within planes of the given normal: one turn, two shifts."""
    n = _unit(normal)
    turn = jnp.concatenate([n, jnp.zeros(3)])
    shifts = jnp.concatenate([jnp.zeros((3, 2)), tangents_to(n).T])
    return jnp.concatenate([turn[:, None], shifts], axis=1)


def translation_only() -> Float[Array, "6 3"]:
    """The basis of shifts."""
    return jnp.concatenate([jnp.zeros((3, 3)), jnp.eye(3)])


def rotation_about(point: Float[Array, " 3"]) -> Float[Array, "6 3"]:
    """The basis of turns about a fixed point of the target's space."""
    # A turn w about c moves x by w x (x - c) = w x x + c x w.
    return jnp.concatenate([jnp.eye(3), _cross_matrix(jnp.asarray(point, float))])


class Tangent(eqx.Module):
    """Coordinates z [k] of a step: xi = basis z about the center of the target.

    Shifts are in units of the size of the cloud, so that they compare with turns.
    `about_origin` z is the same step as a tangent vector about the origin, and
    `from_origin` its left inverse.
    """

    basis: Float[Array, "dof k"]
    about_origin: Float[Array, "dof k"]
    from_origin: Float[Array, "k dof"]

    def coordinates(self, xi: Float[Array, " dof"]) -> Float[Array, " k"]:
        """The z of a tangent vector about the center."""
        return jnp.linalg.lstsq(self.basis, xi)[0]


def tangent_of(model: AbstractModel, center, size) -> Tangent:
    """The step coordinates of a model about a center, for points of a given size."""
    dtype = center.dtype
    eye = jnp.eye(model.dof, dtype=dtype)
    lengths = jax.vmap(lambda e: jnp.any(model.generator(e)[1] != 0))(eye)
    unit = jnp.where(lengths, size, 1).astype(dtype)
    moved = jax.vmap(lambda e: _about(model, e, center), out_axes=1)(eye)
    span = eye
    if model.basis is not None:
        given = moved @ jnp.asarray(model.basis, dtype)
        span, _ = jnp.linalg.qr(given / unit[:, None])
    basis = unit[:, None] * span
    back = jax.vmap(lambda xi: _about(model, xi, -center), 1, 1)(basis)
    return Tangent(basis, back, span.T @ (moved / unit[:, None]))


def _about(model, xi, center):
    """The tangent vector of the same motion in coordinates about `center`."""
    matrix, _ = model.generator(xi)
    places = jax.jacfwd(lambda x: model.generator(x)[1])(xi)
    return xi + places.T @ (matrix @ center)


def _unit(x):
    return safe_normalize(jnp.asarray(x, float))


def _cross_matrix(w):
    x, y, z = w
    o = jnp.zeros_like(x)
    return jnp.stack([o, -z, y, z, o, -x, -y, x, o]).reshape(3, 3)
