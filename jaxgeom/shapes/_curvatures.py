"""How a surface bends."""

import equinox as eqx
from jaxtyping import Array, Float

from .._core import eigen_two


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
        return Curvatures((a + c) / 2, a * c - b * b, eigen_two(form)[0])


class PrincipalCurvatures(eqx.Module):
    """The shape of a surface around every vertex of a mesh, or point of a cloud.

    - `values` [n, 2]: the largest and the least normal curvature, in 1 / length,
      positive where the surface bends away from its normal (a sphere from outside).
    - `directions` [n, 2, 3]: the unit tangents they belong to. Arbitrary, and with
      gradient zero, where both values are the same.
    - `normals` [n, 3].

    All zero where there is no surface, such as for padding.
    """

    values: Float[Array, "n 2"]
    directions: Float[Array, "n 2 3"]
    normals: Float[Array, "n 3"]
