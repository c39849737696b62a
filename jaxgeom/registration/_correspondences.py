"""Which target point belongs to a source point, given the transform so far.

A correspondence prepares the target once and is then asked again and again. Which place
of the target it answers is a constant under differentiation; the place itself is not.
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import GeometryError, message, safe_divide, safe_norm, safe_normalize
from ..neighbors import (
    AbstractBackend,
    AbstractIndex,
    build,
    closest_on_mesh,
    knn,
)
from ..shapes import PointCloud, TriangleMesh
from ._memory import Memory, nearest_pairs


class Found(eqx.Module):
    """Which place of the target belongs to every source point, where `mask`.

    `indices` are those of target points, of faces (then `shares` are the barycentric
    coordinates), or zero for a field.
    """

    indices: Int[Array, " n"]
    mask: Bool[Array, " n"]
    shares: Float[Array, "n 3"] | None = None
    memory: Memory | None = None

    def blank(self) -> "Found":
        """Nothing found yet, of the same shapes."""
        none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self)
        if none.memory is None:
            return none
        beyond = jnp.full_like(none.memory.nearest, jnp.iinfo(jnp.int32).max)
        return eqx.tree_at(lambda f: f.memory.nearest, none, beyond)


class Places(eqx.Module):
    """Points [n, 3] of the target and unit normals, differentiable in the target."""

    points: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]


class AbstractNormalCheck(eqx.Module):
    """Which angles between the normals of a pair are allowed."""

    max_angle: eqx.AbstractVar[Float[Array, ""] | float]

    @abstractmethod
    def cosine(self, cosine: Float[Array, " n"]) -> Float[Array, " n"]:
        """The cosine that is compared with that of `max_angle` (radians)."""

    def __call__(self, source_normals, target_normals) -> Bool[Array, " n"]:
        """Whether the normals [n, 3] agree, row by row."""
        cosine = jnp.sum(source_normals * target_normals, axis=1)
        return self.cosine(cosine) >= jnp.cos(self.max_angle)


class Facing(AbstractNormalCheck):
    """Oriented normals must agree within `max_angle` radians."""

    max_angle: Float[Array, ""] | float = jnp.pi / 4

    def cosine(self, cosine):
        return cosine


class Parallel(AbstractNormalCheck):
    """Normals must agree within `max_angle` radians up to their sign."""

    max_angle: Float[Array, ""] | float = jnp.pi / 4

    def cosine(self, cosine):
        return jnp.abs(cosine)


class AbstractCorrespondence(eqx.Module):
    """A rule that pairs source points with a target; `check` may refuse pairs."""

    check: eqx.AbstractVar[AbstractNormalCheck | None]

    @abstractmethod
    def prepare(self, target):
        """What is needed of the target, built once."""

    @abstractmethod
    def find(
        self, prepared, moved: PointCloud, max_distance, last: Found | None
    ) -> Found:
        """The pairs of the moved source, at most `max_distance` apart.

        `last` is what was found for the same source before it moved on, if anything.
        """

    @abstractmethod
    def places(self, prepared, moved: PointCloud, found: Found) -> Places:
        """Where the pairs are."""

    def match(
        self, prepared, moved: PointCloud, max_distance, last: Found | None = None
    ) -> Found:
        """`find`, without the pairs that `check` refuses."""
        found = self.find(prepared, moved, max_distance, last)
        if self.check is None or moved.normals is None:
            return found
        places = self.places(prepared, moved, found)
        return _only(found, self.check(moved.normals, places.normals))


class Indexed(eqx.Module):
    """The target cloud and its search structure."""

    target: PointCloud
    index: AbstractIndex


class AbstractNearest(AbstractCorrespondence):
    """The nearest target point, where it may be one of a pair.

    A point is searched anew only when it has moved so far that another target point
    could have become the nearest.
    """

    backend: eqx.AbstractVar[AbstractBackend | None]

    @abstractmethod
    def pairs(
        self, moved: PointCloud, places: Places, found: Found
    ) -> Bool[Array, " n"]:
        """Which of the nearest points found make a pair."""

    def prepare(self, target):
        _check_target(target, PointCloud, "this correspondence")
        target = jax.tree.map(jnp.asarray, target)
        index = build(target.points, target.mask, backend=self.backend)
        return Indexed(target, index)

    def find(self, prepared, moved, max_distance, last):
        memory = None if last is None else last.memory
        memory, mask = nearest_pairs(prepared.index, moved, max_distance, memory)
        indices = jnp.where(mask, memory.nearest[:, 0], 0)
        found = Found(indices, mask, memory=memory)
        return _only(
            found, self.pairs(moved, self.places(prepared, moved, found), found)
        )

    def places(self, prepared, moved, found):
        points, normals = prepared.target.points, prepared.target.normals
        there = points[found.indices]
        if normals is None:
            return Places(there, jnp.zeros_like(there))
        return Places(there, normals[found.indices])


class Nearest(AbstractNearest):
    """The nearest target point."""

    check: AbstractNormalCheck | None = None
    backend: AbstractBackend | None = None

    def pairs(self, moved, places, found):
        return found.mask


class Mutual(AbstractNearest):
    """The nearest target point, if the moved source point nearest to it is this one."""

    check: AbstractNormalCheck | None = None
    backend: AbstractBackend | None = None

    def pairs(self, moved, places, found):
        back = _way_back(moved, places, found, self.backend)
        return back == jnp.arange(back.shape[0])


class Reciprocal(AbstractNearest):
    """The nearest target point, if the moved source point nearest to it is within
    `distance` of this one, in the unit of the target."""

    distance: Float[Array, ""] | float
    check: AbstractNormalCheck | None = None
    backend: AbstractBackend | None = None

    def pairs(self, moved, places, found):
        back = _way_back(moved, places, found, self.backend)
        return safe_norm(moved.points[back] - moved.points) <= self.distance


class ClosestSurface(AbstractCorrespondence):
    """The closest point of a `TriangleMesh`, with the gradient of the distance there.

    On the surface itself the normal is that of the face; the mesh must be oriented
    where a `check` is made.
    """

    check: AbstractNormalCheck | None = None

    def prepare(self, target):
        _check_target(target, TriangleMesh, "ClosestSurface")
        return target

    def find(self, prepared, moved, max_distance, last):
        near = closest_on_mesh(prepared, moved.points)
        mask = moved.mask & near.mask & (near.distances <= max_distance)
        return Found(near.faces, mask, near.barycentric)

    def places(self, prepared, moved, found):
        corners = prepared.triangles().at[found.indices].get(mode="fill", fill_value=0)
        points = jnp.einsum("qi,qid->qd", found.shares, corners)
        across = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        face = safe_normalize(across)
        gap = jax.lax.stop_gradient(moved.points) - points
        side = jnp.where(jnp.sum(gap * face, axis=1) < 0, -1, 1).astype(gap.dtype)
        # Nearer than rounding the direction of the gap is noise: the face decides.
        size = jnp.max(jnp.abs(moved.points), axis=1) + jnp.max(jnp.abs(corners))
        rounding = 64 * jnp.finfo(gap.dtype).eps * size
        far = safe_norm(gap) > rounding
        outward = side[:, None] * safe_normalize(gap)
        return Places(points, jnp.where(far[:, None], outward, face))


class DistanceField(AbstractCorrespondence):
    """The foot on the level zero of a field: q = p - f g / |g|^2, g the gradient at p.

    The target is any callable from a point [3] to a number; for a signed distance q is
    the closest point. Coordinates are those of the field.
    """

    check: AbstractNormalCheck | None = None

    def prepare(self, target):
        _check_target(target, Callable, "DistanceField")
        return target

    def find(self, prepared, moved, max_distance, last):
        value, slope = jax.vmap(jax.value_and_grad(prepared))(moved.points)
        square = jnp.sum(slope**2, axis=1)
        near = jnp.abs(value) <= max_distance * jnp.sqrt(square)
        mask = moved.mask & near & (square > 0) & jnp.isfinite(value)
        return Found(jnp.zeros(mask.shape, jnp.int32), mask)

    def places(self, prepared, moved, found):
        points = jax.lax.stop_gradient(moved.points)
        value, slope = jax.vmap(jax.value_and_grad(prepared))(points)
        foot = points - safe_divide(value, jnp.sum(slope**2, axis=1))[:, None] * slope
        return Places(foot, safe_normalize(slope))


def _check_target(target, kind, name):
    if not isinstance(target, kind):
        raise GeometryError(
            message(
                f"{name} needs a {kind.__name__} as target",
                f"{type(target).__name__}",
                "Nearest is for clouds, ClosestSurface for meshes, DistanceField for "
                "callables.",
            )
        )


def _way_back(moved, places, found, backend) -> Int[Array, " n"]:
    """For every pair the source point nearest to its target point."""
    index = build(moved.points, moved.mask, backend=backend)
    near = knn(index, places.points, 1, mask=found.mask)
    return jnp.where(near.mask[:, 0], near.indices[:, 0], 0)


def _only(found, keep) -> Found:
    return eqx.tree_at(lambda f: f.mask, found, found.mask & keep)
