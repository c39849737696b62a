"""How a surface bends at a point."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_norm


class Curvatures(eqx.Module):
    """The curvatures of a surface at a point; positive where it bends away from its
    normal, as a sphere does seen from outside.

    - `mean`: (k1 + k2) / 2, in 1 / length; 1 / r on a sphere.
    - `gaussian`: k1 k2, in 1 / length^2.
    - `principal` [2]: k1 >= k2, in 1 / length.
    """

    mean: Float[Array, ""]
    gaussian: Float[Array, ""]
    principal: Float[Array, " 2"]

    @staticmethod
    def of_form(form: Float[Array, "2 2"]) -> "Curvatures":
        """Half the trace, determinant and eigenvalues of the second fundamental form in
        an orthonormal basis of the tangent plane.

        The derivative of equal eigenvalues is that of their mean.
        """
        (a, b), (_, c) = form
        mean, spread = (a + c) / 2, safe_norm(jnp.stack([(a - c) / 2, b]))
        principal = jnp.stack([mean + spread, mean - spread])
        return Curvatures(mean, a * c - b * b, principal)
