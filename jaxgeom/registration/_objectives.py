"""What is small when a pair of points fits: residuals of one pair.

Objectives are written for one pair, as a function of the moved source point. The rows
of a Gauss-Newton step follow from them by forward differentiation.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Pair(eqx.Module):
    """A moved source point and its target point, each with a unit normal."""

    point: Float[Array, " 3"]
    normal: Float[Array, " 3"]
    there: Float[Array, " 3"]
    there_normal: Float[Array, " 3"]

    @property
    def gap(self) -> Float[Array, " 3"]:
        """From the target point to the moved source point."""
        return self.point - self.there


class AbstractObjective(eqx.Module):
    """The residual rows of one pair, in the unit of the points."""

    @abstractmethod
    def residual(self, pair: Pair) -> Float[Array, " r"]:
        """The rows whose sum of squares is made small."""

    @property
    @abstractmethod
    def normals_of(self) -> tuple[str, ...]:
        """Whose normals it needs: of "source", "target", both or none."""


class PointToPoint(AbstractObjective):
    """p - q: slow to slide along surfaces, but needs no normals (Besl, McKay 1992)."""

    @property
    def normals_of(self):
        return ()

    def residual(self, pair):
        return pair.gap


class PointToPlane(AbstractObjective):
    """n_q . (p - q): the target near q is taken for its plane (Chen, Medioni 1991)."""

    @property
    def normals_of(self):
        return ("target",)

    def residual(self, pair):
        return _dot(pair.there_normal, pair.gap)[None]


class PointToSurface(AbstractObjective):
    """The signed distance of p to the surface, for `ClosestSurface` and
    `DistanceField`: g . (p - q) with q the closest point and g the gradient there."""

    @property
    def normals_of(self):
        return ()

    def residual(self, pair):
        return _dot(pair.there_normal, pair.gap)[None]


class Symmetric(AbstractObjective):
    """(n_p + n_q) . (p - q) / 2: exact where both lie on one arc of a circle.

    Normals are compared up to sign, so they need not be oriented. The source normal
    turns with the source (Rusinkiewicz 2019, A symmetric objective function for ICP,
    eq. 3 with rotated normals).
    """

    @property
    def normals_of(self):
        return ("source", "target")

    def residual(self, pair):
        facing = jax.lax.stop_gradient(_dot(pair.normal, pair.there_normal))
        # The sign of a normal is a discrete choice.
        sign = jnp.where(facing < 0, -1, 1).astype(facing.dtype)
        middle = (pair.normal + sign * pair.there_normal) / 2
        return _dot(middle, pair.gap)[None]


class Generalized(AbstractObjective):
    """M^(-1/2) (p - q), M = C_p + C_q: both surfaces are flat patches with noise.

    C = I - (1 - thickness) n n^T is the covariance of a patch with normal n. With
    c = n_p . n_q the eigenvectors of M are n_p +- n_q, so that the root has a closed
    form that does not divide by their lengths. Residuals are scaled by
    sqrt(2 thickness), so that across parallel patches they are lengths.

    Source: Segal, Haehnel, Thrun 2009, Generalized-ICP, eq. 2.
    """

    thickness: float = 1e-3

    @property
    def normals_of(self):
        return ("source", "target")

    def residual(self, pair):
        cosine = _dot(pair.normal, pair.there_normal)
        total = pair.normal + pair.there_normal
        change = pair.normal - pair.there_normal
        gap = pair.gap
        rows = (
            gap / jnp.sqrt(2.0)
            + self._share(cosine) * _dot(total, gap) * total
            + self._share(-cosine) * _dot(change, gap) * change
        )
        return jnp.sqrt(2 * self.thickness) * rows

    def _share(self, cosine):
        """(l^(-1/2) - 2^(-1/2)) / |n_p +- n_q|^2 with l the eigenvalue of M there."""
        root = jnp.sqrt(2 - (1 - self.thickness) * (1 + cosine))
        rest = jnp.sqrt(2.0)
        return (1 - self.thickness) / (2 * (rest + root) * rest * root)


def _dot(a, b):
    # A sum of products stays elementwise under vmap.
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
