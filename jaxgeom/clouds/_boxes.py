"""Bounding boxes, and what lies in them."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..shapes import PointCloud
from ._frames import frames
from ._outliers import keep

# The search for a smaller box: rounds, and the angle by which they start to turn.
_ROUNDS = 40
_FIRST_TURN = 0.4
_SHRINK = 0.8


class Box(eqx.Module):
    """The points center + axes @ x with |x_d| <= half_extents_d.

    `axes` [3, 3] has orthonormal columns, a rotation.
    """

    center: Float[Array, " 3"]
    axes: Float[Array, "3 3"]
    half_extents: Float[Array, " 3"]

    @property
    def volume(self) -> Float[Array, ""]:
        """The product of the three sides."""
        return jnp.prod(2 * self.half_extents)

    def contains(self, points: Float[Array, "*n 3"]) -> Bool[Array, "*n"]:
        """Where points lie in the box or on its faces, to rounding."""
        local = (points - self.center) @ self.axes
        size = jnp.max(jnp.abs(self.center)) + jnp.max(self.half_extents)
        slack = 8 * jnp.finfo(local.dtype).eps * size
        return jnp.all(jnp.abs(local) <= self.half_extents + slack, axis=-1)

    def corners(self) -> Float[Array, "8 3"]:
        """The eight corners."""
        signs = np.stack(np.meshgrid(*[(-1, 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
        return self.center + (signs * self.half_extents) @ self.axes.T


class AbstractBoxAxes(eqx.Module):
    """How the axes of a bounding box are chosen."""

    @abstractmethod
    def axes(self, points: Float[Array, "n 3"], mask) -> Float[Array, "3 3"]:
        """The columns of a rotation; `points` are about their mean."""


class PrincipalAxes(AbstractBoxAxes):
    """The principal axes of the points: fast, and not the smallest box."""

    def axes(self, points, mask):
        """The eigenvectors of the covariance."""
        spread = jnp.where(mask[:, None], points, 0)
        vectors = frames(spread.T @ spread)[1]
        return vectors * jnp.where(jnp.linalg.det(vectors) < 0, -1, 1)


class MinimalVolume(AbstractBoxAxes):
    """Axes that no small turn improves.

    The principal axes and those of the coordinates are turned about each other by ever
    smaller angles while the volume falls, and the smaller box is taken: a local
    minimum, which on scans lies within a few percent of the smallest box.
    """

    def axes(self, points, mask):
        """The better of the two improved frames."""
        eye = jnp.eye(3, dtype=points.dtype)
        starts = jnp.stack([PrincipalAxes().axes(points, mask), eye])
        better = jax.lax.map(lambda axes: _improve(points, mask, axes), starts)
        volumes = jax.vmap(lambda axes: _volume(points, mask, axes))(better)
        return better[jnp.argmin(volumes)]


def bounding_box(cloud: PointCloud) -> Box:
    """The smallest box along the axes that holds the real points.

    Differentiable in the points at its faces; a cloud without points gets a box without
    extent at the origin.
    """
    points = cloud.washed().points
    return _box(points, cloud.mask, jnp.eye(3, dtype=points.dtype))


def oriented_box(cloud: PointCloud, *, method: AbstractBoxAxes | None = None) -> Box:
    """A turned box that holds the real points.

    `method` is `MinimalVolume()` (the default) or `PrincipalAxes()`; its choice of axes
    is a constant under differentiation.
    """
    method = MinimalVolume() if method is None else method
    points, mask = cloud.washed().points, jnp.asarray(cloud.mask)
    count = jnp.maximum(jnp.sum(mask), 1)
    mean = jnp.sum(points, axis=0) / count
    still = jax.lax.stop_gradient(jnp.where(mask[:, None], points - mean, 0))
    return _box(points, mask, method.axes(still, mask))


def crop(
    cloud: PointCloud, region: Box | Callable[[Float[Array, " 3"]], Array]
) -> PointCloud:
    """The cloud with only the real points in `region`; the rest becomes padding.

    `region` is a `Box`, a field (points where it is not positive stay) or any predicate
    of one point [3] that gives a boolean.
    """
    points = cloud.washed().points
    if isinstance(region, Box):
        return keep(cloud, region.contains(points))
    value = jax.vmap(region)(points)
    return keep(cloud, value if value.dtype == bool else value <= 0)


def _box(points, mask, axes) -> Box:
    low, high = _sides(points, mask, axes)
    return Box(axes @ ((low + high) / 2), axes, (high - low) / 2)


def _sides(points, mask, axes):
    local, some = points @ axes, jnp.any(mask)
    low = jnp.min(jnp.where(mask[:, None], local, jnp.inf), axis=0)
    high = jnp.max(jnp.where(mask[:, None], local, -jnp.inf), axis=0)
    return jnp.where(some, low, 0), jnp.where(some, high, 0)


def _volume(points, mask, axes):
    low, high = _sides(points, mask, axes)
    return jnp.prod(high - low)


def _improve(points, mask, axes):
    """The axes after turns about each of them, both ways, by ever smaller angles."""

    def round_(carry, angle):
        axes, least = carry
        c, s = jnp.cos(angle), jnp.sin(angle)
        eye = jnp.eye(3, dtype=points.dtype)
        turns = [
            eye.at[d, d].set(c).at[e, e].set(c).at[d, e].set(-w).at[e, d].set(w)
            for d, e in ((0, 1), (0, 2), (1, 2))
            for w in (s, -s)
        ]
        tried = jnp.einsum("ij,tjk->tik", axes, jnp.stack(turns))
        volumes = jax.lax.map(lambda x: _volume(points, mask, x), tried)
        best = jnp.argmin(volumes)
        better = volumes[best] < least
        axes = jnp.where(better, tried[best], axes)
        return (axes, jnp.where(better, volumes[best], least)), None

    angles = _FIRST_TURN * _SHRINK ** jnp.arange(_ROUNDS, dtype=points.dtype)
    start = (axes, _volume(points, mask, axes))
    return jax.lax.scan(round_, start, jnp.repeat(angles, 2))[0][0]
