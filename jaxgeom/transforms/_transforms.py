"""The three groups of maps: rigid (6 parameters), similarity (7), affine (12).

In the plane they have 3, 4 and 6; beyond space they have no exponential map. Every
transform acts on points as x' = M x + t, on normals as the inverse transpose of M
(normalised), composes right to left with `@`, and is named after both its ends:
`target_from_source`. One of numpy arrays, such as the doors return, keeps their double
precision in all of this but its normals.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, message, safe_normalize
from ..shapes import PointCloud, TriangleMesh
from ._rotations import left_jacobian, rotation_exp, rotation_log, skew_matrix


class AbstractTransform(eqx.Module):
    """A map x' = M x + t of space (d = 3), of the plane or of any dimension d."""

    @abstractmethod
    def linear(self) -> Float[Array, "d d"]:
        """The matrix M."""

    @abstractmethod
    def shift(self) -> Float[Array, " d"]:
        """The vector t."""

    def __call__(self, shape):
        """The image of points [..., d], a `PointCloud` or a `TriangleMesh`."""
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

    def points(self, points: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        """M x + t for every point."""
        return points @ self.linear().T + self.shift()

    def normals(self, normals: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        """The unit normals of the moved surface: M^-T n, normalised."""
        return safe_normalize(normals @ jnp.linalg.inv(self.linear()))

    def matrix(self) -> Float[Array, "d+1 d+1"]:
        """The homogeneous matrix [[M, t], [0, 1]]."""
        linear, shift = self.linear(), self.shift()
        library = np if isinstance(linear, np.ndarray) else jnp
        top = library.concatenate([linear, shift[:, None]], axis=1)
        last = library.eye(top.shape[1], dtype=top.dtype)[-1:]
        return library.concatenate([top, last])


class Rigid(AbstractTransform):
    """x' = R x + t, with R a rotation [d, d] and t [d] in the unit of the points."""

    rotation: Float[Array, "d d"]
    translation: Float[Array, " d"]

    @staticmethod
    def identity(dtype=None, *, dimension: int = 3) -> "Rigid":
        """The map that moves nothing."""
        return Rigid(jnp.eye(dimension, dtype=dtype), jnp.zeros(dimension, dtype))

    @staticmethod
    def exp(twist: Float[Array, " 6"]) -> "Rigid":
        """The motion of a twist (rotation vector in radians, then velocity).

        R = exp([w]x), t = V(w) v with V = I + b [w]x + c [w]x^2 (the left Jacobian).
        In the plane a twist is an angle and a velocity, [3].
        """
        d = _dimension(twist, {3: 2, 6: 3})
        w, v = twist[:-d], twist[-d:]
        return Rigid(rotation_exp(w), left_jacobian(w) @ v)

    def log(self) -> Float[Array, " 6"]:
        """The twist whose `exp` this is; rotation angle at most pi."""
        w = rotation_log(self.rotation)
        v = jnp.linalg.solve(left_jacobian(w), self.translation)
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
    """x' = s R x + t, with s > 0 a scalar, R a rotation [d, d], t [d]."""

    scale: Float[Array, ""]
    rotation: Float[Array, "d d"]
    translation: Float[Array, " d"]

    @staticmethod
    def identity(dtype=None, *, dimension: int = 3) -> "Similarity":
        """The map that moves nothing."""
        rigid = Rigid.identity(dtype, dimension=dimension)
        return Similarity(jnp.ones((), dtype), rigid.rotation, rigid.translation)

    @staticmethod
    def exp(tangent: Float[Array, " 7"]) -> "Similarity":
        """The map of a tangent vector (rotation vector, velocity, log of the scale).

        The matrix exponential of [[log s I + [w]x, v], [0, 0]]. In the plane a tangent
        vector is an angle, a velocity and the log of the scale, [4].
        """
        d = _dimension(tangent, {4: 2, 7: 3})
        w, v, log_scale = tangent[: -d - 1], tangent[-d - 1 : -1], tangent[-1]
        generator = log_scale * jnp.eye(d, dtype=w.dtype) + skew_matrix(w)
        matrix = _expm(generator, v)
        return Similarity(jnp.exp(log_scale), rotation_exp(w), matrix[:d, d])

    def log(self) -> Float[Array, " 7"]:
        """The tangent vector whose `exp` this is; rotation angle at most pi."""
        w = rotation_log(self.rotation)
        log_scale = jnp.log(self.scale)
        eye = jnp.eye(self.translation.shape[0], dtype=w.dtype)
        generator = log_scale * eye + skew_matrix(w)
        # t = (integral of exp(u G) du) v, and expm of a block matrix is that integral.
        columns = [_expm(generator, e)[:-1, -1] for e in eye]
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
    """x' = M x + t, with M any matrix [d, d]."""

    coefficients: Float[Array, "d d"]
    translation: Float[Array, " d"]

    @staticmethod
    def identity(dtype=None, *, dimension: int = 3) -> "Affine":
        """The map that moves nothing."""
        return Affine(jnp.eye(dimension, dtype=dtype), jnp.zeros(dimension, dtype))

    @staticmethod
    def of(transform: AbstractTransform) -> "Affine":
        """Any transform as an affine one."""
        return Affine(transform.linear(), transform.shift())

    @staticmethod
    def exp(tangent: Float[Array, " 12"]) -> "Affine":
        """The map of a generator (its matrix by rows, then velocity).

        [12] in space, [6] in the plane.
        """
        d = _dimension(tangent, {6: 2, 12: 3})
        matrix = _expm(tangent[:-d].reshape(d, d), tangent[-d:])
        return Affine(matrix[:d, :d], matrix[:d, d])

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
        return jnp.concatenate([real[:-1, :-1].reshape(-1), real[:-1, -1]])

    def linear(self):
        return self.coefficients

    def shift(self):
        return self.translation

    def __matmul__(self, other: AbstractTransform) -> "Affine":
        """First `other` (of any kind), then this."""
        return Affine(self.coefficients @ other.linear(), self.points(other.shift()))

    def inverse(self) -> "Affine":
        """The map back; entries are not finite for a singular matrix."""
        back = _inverse(self.coefficients)
        return Affine(back, -back @ self.translation)


def _inverse(matrix):
    """The inverse, not finite for a singular matrix, in the precision of the matrix."""
    if not isinstance(matrix, np.ndarray):
        return jnp.linalg.inv(matrix)
    try:
        return np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        return np.full_like(matrix, np.nan)


def _dimension(tangent, sizes: dict[int, int]) -> int:
    """The dimension of the space whose group has tangent vectors of this size."""
    if tangent.ndim != 1 or tangent.shape[0] not in sizes:
        wanted = " or ".join(f"[{size}]" for size in sizes)
        raise GeometryError(
            message(
                f"a tangent vector must have shape {wanted}",
                f"shape {tangent.shape}",
                "Pass one vector at a time and batch with jax.vmap.",
            )
        )
    return sizes[tangent.shape[0]]


def _expm(generator, velocity):
    """The matrix exponential of [[G, v], [0, 0]]."""
    d = generator.shape[0]
    block = jnp.zeros((d + 1, d + 1), generator.dtype)
    return jsl.expm(block.at[:d, :d].set(generator).at[:d, d].set(velocity))
