"""Inside or not, derivatives of a field, and the curvatures of its level sets."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import safe_divide, safe_norm, safe_normalize, tangents_to
from ..shapes import Curvatures


def inside(field: Callable, points: Float[Array, "*n 3"]) -> Bool[Array, "*n"]:
    """Whether points [..., 3] lie in the body: f < 0. The surface is not inside."""
    points = jnp.asarray(points)
    flat = jax.vmap(field)(points.reshape(-1, points.shape[-1]))
    return flat.reshape(points.shape[:-1]) < 0


def gradient(field: Callable, point: Float[Array, " 3"]) -> Float[Array, " 3"]:
    """grad f at one point, in units of f per length; of length 1 for a distance."""
    return jax.grad(field)(jnp.asarray(point))


def hessian(field: Callable, point: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """The second derivatives d^2 f / dx_i dx_j at one point, f per length squared."""
    return jax.jacfwd(jax.grad(field))(jnp.asarray(point))


def curvatures(field: Callable, point: Float[Array, " 3"]) -> Curvatures:
    """The curvatures of the level set of a field through one point.

    The shape operator S = T^T H T / |grad f|, with H the Hessian and T [3, 2] an
    orthonormal basis of the tangent plane: mean = tr S / 2, Gaussian = det S, and the
    principal curvatures are its eigenvalues. In the terms of the source,
    mean = (|g|^2 tr H - g^T H g) / (2 |g|^3), Gaussian = g^T adj(H) g / |g|^4.

    Values need not be distances. All are zero where the gradient vanishes, as at the
    center of a sphere. Differentiable; at umbilics (k1 = k2) the derivative of
    `principal` is that of the mean.

    Source: R. Goldman, Curvature formulas for implicit curves and surfaces, 2005.
    """
    slope = gradient(field, point)
    basis = tangents_to(safe_normalize(slope))
    shape = safe_divide(basis @ hessian(field, point) @ basis.T, safe_norm(slope))
    return Curvatures.of_form(shape)
