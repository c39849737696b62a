"""How far a pose may be off, from the residuals at its minimum."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide
from ._icp import Registration


def pose_covariance(found: Registration) -> Float[Array, "dof dof"]:
    """sigma^2 H^-1: the covariance of the tangent vector from the truth to the pose.

    sigma^2 is the variance of the residuals with the weights of the kernel, H the
    information matrix (Laplace's approximation). Residuals are taken for independent.
    Tangent vectors are about the origin: rotation vector in radians, then translation.
    """
    count = found.num_matches.astype(found.rmse.dtype)
    dof = found.information.shape[0]
    effective = jnp.maximum(count - dof, 1)
    return found.rmse**2 * safe_divide(count, effective) * _inverse(found.information)


def sandwich_covariance(found: Registration) -> Float[Array, "dof dof"]:
    """H^-1 M H^-1 with M = sum (w rho' J^T r)(w rho' J^T r)^T.

    Holds also where the noise differs from pair to pair. Source: Huber 1967; White
    1980.
    """
    back = _inverse(found.information)
    return back @ found.scatter @ back


def _inverse(matrix):
    """The inverse of a positive matrix whose rows have different units."""
    root = jnp.sqrt(jnp.diagonal(matrix))
    unit = jnp.where(root > 0, root, 1)
    return jnp.linalg.inv(matrix / jnp.outer(unit, unit)) / jnp.outer(unit, unit)
