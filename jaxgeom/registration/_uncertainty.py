"""How far a pose may be off, from the residuals at its minimum."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide
from ._report import Registration


def pose_covariance(found: Registration) -> Float[Array, "dof dof"]:
    """sigma^2 H^-1: the covariance of the tangent vector from the truth to the pose.

    H is the information matrix (Laplace's approximation) and sigma = noise / sharpness:
    the weights of a kernel make both the pull and the stiffness of a pair smaller, as
    in Huber's formula sigma^2 = mean(psi^2) / mean(psi')^2. Residuals are taken for
    independent and alike. For `Trimmed`, whose pull jumps, it is too small. Tangent
    vectors are about the origin: rotation vector in radians, then translation.

    Source: Huber 1981, Robust statistics, 7.6.
    """
    count = found.num_matches.astype(found.rmse.dtype)
    dof = found.information.shape[0]
    effective = jnp.maximum(count - dof, 1)
    sigma = safe_divide(found.noise, found.sharpness)
    return sigma**2 * safe_divide(count, effective) * _inverse(found.information)


def sandwich_covariance(found: Registration) -> Float[Array, "dof dof"]:
    """B M B with M = sum (w rho' J^T r)(w rho' J^T r)^T, B = H^-1 / sharpness.

    Holds also where the noise differs from pair to pair. Source: Huber 1967; White
    1980.
    """
    back = safe_divide(_inverse(found.information), found.sharpness)
    return back @ found.scatter @ back


def _inverse(matrix):
    """The inverse of a positive matrix whose rows have different units."""
    root = jnp.sqrt(jnp.diagonal(matrix))
    unit = jnp.where(root > 0, root, 1)
    return jnp.linalg.inv(matrix / jnp.outer(unit, unit)) / jnp.outer(unit, unit)
