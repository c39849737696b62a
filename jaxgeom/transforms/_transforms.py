"""The three groups of maps: rigid (6 parameters), similarity (7), affine (12).

Every transform acts on points as x' = M x + t, on normals as the inverse transpose of
M (normalised), composes right to left with `@`, and is named after both its ends:
`target_from_source`.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, message, safe_normalize
from ..shapes import PointCloud, TriangleMesh
from ._rotations import cross_matrix, rotation_exp, rotation_log


class AbstractTransform(eqx.Module):
    """A map x' = M x + t of space."""

    @abstractmethod
    def linear(self) -> Float[Array, "3 3"]:
        """The matrix M."""

    @abstractmethod
    def shift(self) -> Float[Array, " 3"]:
        """The vector t."""

    def __call__(self, shape):
        """The image of points [..., 3], a `PointCloud` or a `TriangleMesh`."""
        if isinstance(shape, PointCloud):
            return self._move(shape, lambda cloud: (cloud.points, cloud.normals))
        if isinstance(shape, TriangleMesh):
            return self._move(shape, lambda mesh: (mesh.vertices, mesh.normals))
        return self.points(shape)

    def _move(self, shape, where):
        points, normals = where(shape)
        moved = (
            self.points(points),
            None if normals is None else self.normals(normals),
        )
        return eqx.tree_at(where, shape, moved, is_leaf=lambda x: x is None)

    def points(self, points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """M x + t for every point."""
        return points @ self.linear().T + self.shift()

    def normals(self, normals: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """The unit normals of the moved surface: M^-T n, normalised."""
        return safe_normalize(normals @ jnp.linalg.inv(self.linear()))

    def matrix(self) -> Float[Array, "4 4"]:
        """The homogeneous matrix [[M, t], [0, 1]]."""
        top = jnp.concatenate([self.linear(), self.shift()[:, None]], axis=1)
        return jnp.concatenate([top, jnp.eye(4, dtype=top.dtype)[3:]])


class Rigid(AbstractTransform):
    """x' = R x + t, with R a rotation [3, 3] and t [3] in the unit of the points."""

    rotation: Float[Array, "3 3"]
    translation: Float[Array, " 3"]

    @staticmethod
    def identity(dtype=None) -> "Rigid":
        """The map that moves nothing."""
        return Rigid(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype))

    @staticmethod
    def exp(twist: Float[Array, " 6"]) -> "Rigid":
        """The motion of a twist (rotation vector in radians, then velocity).

        R = exp([w]x), t = V(w) v with V = I + b [w]x + c [w]x^2 (the left Jacobian).
        """
        w, v = twist[:3], twist[3:]
        return Rigid(rotation_exp(w), _left_jacobian(w) @ v)

    def log(self) -> Float[Array, " 6"]:
        """The twist whose `exp` this is; rotation angle at most pi."""
        w = rotation_log(self.rotation)
        v = jnp.linalg.solve(_left_jacobian(w), self.translation)
        return jnp.concatenate([w, v])

    def linear(self):
        return self.rotation

    def shift(self):
        return self.translation

    def __matmul__(self, other: "Rigid") -> "Rigid":
        """First `other`, then this."""
        return Rigid(self.rotation @ other.rotation, self.points(other.translation))

    def inverse(self) -> "Rigid":
        """The motion back."""
        back = self.rotation.T
        return Rigid(back, -back @ self.translation)


class Similarity(AbstractTransform):
    """x' = s R x + t, with s > 0 a scalar, R a rotation [3, 3], t [3]."""

    scale: Float[Array, ""]
    rotation: Float[Array, "3 3"]
    translation: Float[Array, " 3"]

    @staticmethod
    def identity(dtype=None) -> "Similarity":
        """The map that moves nothing."""
        return Similarity(
            jnp.ones((), dtype), jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype)
        )

    @staticmethod
    def exp(tangent: Float[Array, " 7"]) -> "Similarity":
        """The map of a tangent vector (rotation vector, velocity, log of the scale).

        The matrix exponential of [[log s I + [w]x, v], [0, 0]].
        """
        generator = tangent[6] * jnp.eye(3, dtype=tangent.dtype) + cross_matrix(
            tangent[:3]
        )
        matrix = _expm(generator, tangent[3:6])
        return Similarity(jnp.exp(tangent[6]), rotation_exp(tangent[:3]), matrix[:3, 3])

    def log(self) -> Float[Array, " 7"]:
        """The tangent vector whose `exp` this is."""
        w = rotation_log(self.rotation)
        log_scale = jnp.log(self.scale)
        generator = log_scale * jnp.eye(3, dtype=w.dtype) + cross_matrix(w)
        # t = (integral of exp(u G) du) v, and expm of a block matrix is that integral.
        columns = [_expm(generator, e)[:3, 3] for e in jnp.eye(3, dtype=w.dtype)]
        v = jnp.linalg.solve(jnp.stack(columns, axis=1), self.translation)
        return jnp.concatenate([w, v, log_scale[None]])

    def linear(self):
        return self.scale * self.rotation

    def shift(self):
        return self.translation

    def __matmul__(self, other: "Similarity") -> "Similarity":
        """First `other`, then this."""
        return Similarity(
            self.scale * other.scale,
            self.rotation @ other.rotation,
            self.points(other.translation),
        )

    def inverse(self) -> "Similarity":
        """The map back."""
        back, scale = self.rotation.T, 1 / self.scale
        return Similarity(scale, back, -scale * (back @ self.translation))


class Affine(AbstractTransform):
    """x' = M x + t, with M any matrix [3, 3]."""

    coefficients: Float[Array, "3 3"]
    translation: Float[Array, " 3"]

    @staticmethod
    def identity(dtype=None) -> "Affine":
        """The map that moves nothing."""
        return Affine(jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype))

    @staticmethod
    def of(transform: AbstractTransform) -> "Affine":
        """Any transform as an affine one."""
        return Affine(transform.linear(), transform.shift())

    @staticmethod
    def exp(tangent: Float[Array, " 12"]) -> "Affine":
        """The map of a generator (its 3 x 3 matrix by rows, then velocity)."""
        matrix = _expm(tangent[:9].reshape(3, 3), tangent[9:])
        return Affine(matrix[:3, :3], matrix[:3, 3])

    def log(self) -> Float[Array, " 12"]:
        """The generator whose `exp` this is (host: scipy; M without eigenvalues <= 0).

        Raises `GeometryError` where the matrix has no real logarithm.
        """
        from scipy.linalg import logm

        generator = logm(np.asarray(self.matrix(), np.float64))
        if np.abs(np.imag(generator)).max() > np.finfo(np.float32).eps:
            raise GeometryError(
                message(
                    "the matrix must have no eigenvalue on the negative real axis",
                    f"eigenvalues {np.linalg.eigvals(np.asarray(self.coefficients))}",
                    "Factor a reflection out first.",
                )
            )
        real = jnp.asarray(np.real(generator), self.translation.dtype)
        return jnp.concatenate([real[:3, :3].reshape(9), real[:3, 3]])

    def linear(self):
        return self.coefficients

    def shift(self):
        return self.translation

    def __matmul__(self, other: AbstractTransform) -> "Affine":
        """First `other` (of any kind), then this."""
        return Affine(self.coefficients @ other.linear(), self.points(other.shift()))

    def inverse(self) -> "Affine":
        """The map back; entries are not finite for a singular matrix."""
        back = jnp.linalg.inv(self.coefficients)
        return Affine(back, -back @ self.translation)


def _expm(generator, velocity):
    """The matrix exponential of [[G, v], [0, 0]]."""
    block = jnp.zeros((4, 4), generator.dtype)
    return jsl.expm(block.at[:3, :3].set(generator).at[:3, 3].set(velocity))


def _left_jacobian(w):
    """V = I + (1 - cos t)/t^2 [w]x + (t - sin t)/t^3 [w]x^2 with t = |w|."""
    square = jnp.dot(w, w)
    small = square < jnp.finfo(w.dtype).eps ** 0.5
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    b_large = 2 * jnp.sin(angle / 2) ** 2 / safe
    b = jnp.where(small, 0.5 - square / 24 + square**2 / 720, b_large)
    c_large = (angle - jnp.sin(angle)) / (safe * angle)
    c = jnp.where(small, 1 / 6 - square / 120 + square**2 / 5040, c_large)
    k = cross_matrix(w)
    return jnp.eye(3, dtype=w.dtype) + b * k + c * (k @ k)
