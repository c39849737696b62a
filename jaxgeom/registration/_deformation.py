"""What a model of deformation promises, and what all models share.

A model carries frames: places that move, each with a linear map of what lies around it.
They sit on the vertices themselves or on the nodes of a graph. A tangent [g, d] changes
them, and rows of residuals say how unwillingly.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core import safe_divide, safe_norm
from ..shapes import TriangleMesh


class Frames(eqx.Module):
    """Places [g, 3] and the linear maps [g, 3, 3] of what lies around them."""

    points: Float[Array, "g 3"]
    linear: Float[Array, "g 3 3"]

    @staticmethod
    def at(points: Float[Array, "g 3"]) -> "Frames":
        """Frames that have not moved."""
        eye = jnp.eye(3, dtype=points.dtype)
        return Frames(points, jnp.broadcast_to(eye, (points.shape[0], 3, 3)))


class Links(eqx.Module):
    """Pairs of frames that hold each other: from `start` to `end`, by `weights` [e].

    Weights add up to 1 and are zero for padding; `length` is the weighted root mean
    square of the lengths at rest.
    """

    start: Int[Array, " e"]
    end: Int[Array, " e"]
    weights: Float[Array, " e"]
    length: Float[Array, ""]

    def between(self, points: Float[Array, "g 3"]) -> Float[Array, "e 3"]:
        """The vectors from start to end."""
        return points[self.end] - points[self.start]


class AbstractDeformation(eqx.Module):
    """How a mesh may deform. All lengths are in units of its half diagonal."""

    @property
    @abstractmethod
    def freedoms(self) -> int:
        """The numbers that move one frame."""

    @abstractmethod
    def prepare(self, mesh: TriangleMesh):
        """All that depends on the mesh at rest, with frames `rest` and `links`."""

    @abstractmethod
    def move(self, prepared, frames: Frames, tangent: Float[Array, "g d"]) -> Frames:
        """The frames after a small change; entries of the tangent are lengths."""

    @abstractmethod
    def strain(self, prepared, frames: Frames) -> tuple[Float[Array, "..."], ...]:
        """Rows whose sum of squares is the energy: zero for rigid motions at least."""

    def vertices(self, prepared, frames: Frames) -> Float[Array, "v 3"]:
        """Where the vertices are."""
        return prepared.carry(frames)


def links(start, end, weights, points) -> Links:
    """Links with weights scaled to sum 1, and their length."""
    weights = safe_divide(weights, jnp.sum(weights))
    square = jnp.sum((points[end] - points[start]) ** 2, axis=-1)
    length = jnp.sqrt(jnp.sum(weights * square))
    return Links(start, end, weights, jnp.where(length > 0, length, 1))


def half_edges(mesh: TriangleMesh):
    """Ends of the sides of all faces [3f], and the cotangent of the angle opposite.

    Negative cotangents are taken as zero, so that no weight pushes apart; padding
    gets the ends 0 and weight zero.
    """
    faces = jnp.where(mesh.face_mask[:, None], mesh.faces, 0)
    start, end, apex = (jnp.roll(faces, -i, axis=1).reshape(-1) for i in range(3))
    points = mesh.vertices
    one, two = points[start] - points[apex], points[end] - points[apex]
    cosine = jnp.sum(one * two, axis=-1)
    cotangent = safe_divide(cosine, safe_norm(jnp.cross(one, two)))
    real = jnp.repeat(mesh.face_mask, 3, total_repeat_length=start.shape[0])
    return start, end, jnp.where(real, jnp.maximum(cotangent, 0), 0), real
