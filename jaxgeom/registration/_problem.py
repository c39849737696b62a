"""The least-squares problem at fixed pairs, in coordinates of a step."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..shapes import PointCloud
from ..transforms import Affine, Rigid, Similarity
from ._correspondences import Places
from ._kernels import AbstractKernel
from ._models import AbstractModel, Tangent
from ._objectives import AbstractObjective, Pair


class Normals(eqx.Module):
    """Gauss-Newton's normal equations H z = -g at z = 0, and the cost there."""

    matrix: Float[Array, "k k"]
    gradient: Float[Array, " k"]
    energy: Float[Array, ""]


class Problem(eqx.Module):
    """sum_i w_i width^2 rho(|r_i(exp(xi) T)|^2 / width^2) + prior, xi = basis z.

    The moved source and its target points, coordinate by coordinate [3, n], which is
    several times faster than point by point. Coordinates are about the center of the
    target; only `pose`, which is T, is about the origin.
    """

    points: Float[Array, "3 n"]
    normals: Float[Array, "3 n"]
    there: Float[Array, "3 n"]
    there_normals: Float[Array, "3 n"]
    weights: Float[Array, " n"]
    width: Float[Array, ""]
    tangent: Tangent
    pose: Rigid | Similarity | Affine
    objective: AbstractObjective
    kernel: AbstractKernel
    model: AbstractModel

    @property
    def size(self) -> int:
        """The number of step coordinates k."""
        return self.tangent.basis.shape[1]

    def residuals(self, z: Float[Array, " k"]) -> Float[Array, "r n"]:
        """The rows of every pair after the step z."""
        step = self.model.exp(self.tangent.basis @ z)
        matrix, shift = step.linear(), step.shift()
        points = _times(matrix, self.points) + shift[:, None]
        normals = _turned(matrix, self.normals)
        return self._rows(points, normals)

    def squares(self, z: Float[Array, " k"]) -> Float[Array, " n"]:
        """The squared residual of every pair after the step z."""
        return jnp.sum(self.residuals(z) ** 2, axis=0)

    def energy(self, z: Float[Array, " k"]) -> Float[Array, ""]:
        """The cost after the step z."""
        return self._cost(self.squares(z)) + jnp.sum(self.prior_rows(z) ** 2)

    def rescaled(self, z: Float[Array, " k"]) -> Float[Array, " m"]:
        """Rows whose plain sum of squares is the cost: sqrt(w rho(s) / s) r.

        Differentiable, unlike weights held fixed.
        """
        rows = self.residuals(z)
        s = jnp.sum(rows**2, axis=0) / self.width**2
        positive = s > 0
        safe = jnp.where(positive, s, 1)
        ratio = jnp.where(positive, self.kernel.rho(safe) / safe, 1)
        some = self.weights > 0
        root = jnp.where(some, jnp.sqrt(jnp.where(some, self.weights, 1) * ratio), 0)
        return jnp.concatenate([(root * rows).reshape(-1), self.prior_rows(z)])

    def linearized(self) -> tuple[Float[Array, "r n"], Float[Array, "k r n"]]:
        """The rows at z = 0 and their derivatives."""

        def rows(z):
            # To first order the step is x + G x + v, and normals turn by -G^T.
            matrix, shift = self.model.generator(self.tangent.basis @ z)
            points = self.points + _times(matrix, self.points) + shift[:, None]
            turn = _times(matrix.T, self.normals)
            drift = sum(a * b for a, b in zip(self.normals, turn, strict=True))
            return self._rows(points, self.normals - turn + drift * self.normals)

        zero = jnp.zeros(self.size, self.points.dtype)
        at_zero, push = jax.linearize(rows, zero)
        slopes = jax.vmap(push)(jnp.eye(self.size, dtype=zero.dtype))
        return at_zero, slopes

    def robust_weights(self, rows: Float[Array, "r n"]) -> Float[Array, " n"]:
        """w_i rho'(s_i)."""
        return self.weights * self.kernel.weight(
            jnp.sum(rows**2, axis=0) / self.width**2
        )

    def curvatures(self, rows: Float[Array, "r n"]) -> Float[Array, " n"]:
        """w_i (rho' + 2 s rho'' / r): the second derivatives by a row, their mean."""
        s = jnp.sum(rows**2, axis=0) / self.width**2
        weight, slope = jax.jvp(self.kernel.weight, (s,), (jnp.ones_like(s),))
        return self.weights * (weight + 2 * s * slope / rows.shape[0])

    def normal_equations(self) -> Normals:
        """Gauss-Newton at z = 0 with the weights rho'."""
        rows, slopes = self.linearized()
        weights = self.robust_weights(rows)
        k = self.size
        table = jnp.concatenate([slopes, rows[None]]).reshape(k + 1, -1)
        weights = jnp.broadcast_to(weights, rows.shape).reshape(-1)
        products = (table * weights) @ table.T
        matrix, gradient = products[:k, :k], products[:k, k]
        energy = self._cost(jnp.sum(rows**2, axis=0))
        if self.model.prior is not None:
            zero = jnp.zeros(k, rows.dtype)
            extra, slope = self.prior_rows(zero), jax.jacfwd(self.prior_rows)(zero)
            matrix, gradient = matrix + slope.T @ slope, gradient + slope.T @ extra
            energy = energy + jnp.sum(extra**2)
        return Normals(matrix, gradient, energy)

    def prior_rows(self, z: Float[Array, " k"]) -> Float[Array, " p"]:
        """The rows of the prior on the pose; none without one."""
        prior = self.model.prior
        if prior is None:
            return jnp.zeros(0, self.points.dtype)
        moved = self.model.exp(self.tangent.about_origin @ z) @ self.pose
        gap = self.model.difference(moved, prior.mean)
        root = jnp.linalg.cholesky(jnp.asarray(prior.covariance, gap.dtype))
        return prior.noise * jax.scipy.linalg.solve_triangular(root, gap, lower=True)

    def _rows(self, points, normals):
        pairs = Pair(points, normals, self.there, self.there_normals)
        rows = jax.vmap(self.objective.residual, in_axes=-1, out_axes=-1)(pairs)
        # Where there is no pair the rows are zero, whatever the padding holds.
        return jnp.where(self.weights > 0, rows, 0)

    def _cost(self, squares):
        rho = self.kernel.rho(squares / self.width**2)
        return self.width**2 * jnp.sum(self.weights * rho)


def problem_of(
    moved: PointCloud,
    places: Places,
    mask: Bool[Array, " n"],
    weights: Float[Array, " n"],
    width: Float[Array, ""],
    **parts,
) -> Problem:
    """The problem of the pairs where `mask`."""
    wash = lambda x: jnp.where(mask, x.T, 0)
    normals = jnp.zeros_like(moved.points) if moved.normals is None else moved.normals
    given = (moved.points, normals, places.points, places.normals)
    # Written down once: XLA would look the places up again wherever they are used.
    written = jax.lax.optimization_barrier(tuple(wash(x) for x in given))
    return Problem(
        *written,
        jnp.where(mask, weights, 0),
        width,
        **parts,
    )


def _turned(matrix, normals):
    """M^-T n, of unit length."""
    turned = _times(jnp.linalg.inv(matrix).T, normals)
    square = sum(x**2 for x in turned)
    some = square > 0
    return jnp.where(some, turned / jnp.sqrt(jnp.where(some, square, 1)), 0)


def _times(matrix: Float[Array, "3 3"], rows: Float[Array, "3 n"]):
    """matrix @ rows, written out: on a CPU a call for so small a product costs more
    than the product."""
    part = lambda row: sum(row[j] * rows[j] for j in range(3))
    return jnp.stack([part(row) for row in matrix])
