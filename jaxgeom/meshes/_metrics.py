"""Distances between clouds, and between clouds and meshes."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import GeometryError, masked_mean, message, safe_divide, safe_normalize
from ..neighbors import BruteForce, build, closest_on_mesh, knn
from ..shapes import PointCloud, TriangleMesh

_FEW = 1024


class Match(eqx.Module):
    """The nearest point of another cloud for every point.

    `distances` [n], `cosines` [n] (absolute, of the normals; None without normals),
    `mask` [n] True for the real points. Distances to an empty cloud are infinite.
    """

    distances: Float[Array, " n"]
    cosines: Float[Array, " n"] | None
    mask: Bool[Array, " n"]

    def mean(self) -> Float[Array, ""]:
        """The mean distance."""
        return masked_mean(self.distances, self.mask)

    def max(self) -> Float[Array, ""]:
        """The largest distance; 0 where there is no point."""
        return jnp.max(jnp.where(self.mask, self.distances, 0), initial=0)

    def share_within(self, threshold) -> Float[Array, ""]:
        """The share of the points that lie at most `threshold` away."""
        near = (self.distances <= threshold).astype(self.distances.dtype)
        return masked_mean(near, self.mask)

    def mean_cosine(self) -> Float[Array, ""]:
        """The mean absolute cosine of the normals."""
        return masked_mean(self.cosines, self.mask)


class PointToMesh(eqx.Module):
    """Exact distances of points [n] to a surface.

    `mask` is False for padding, for points that are not finite, and for all points if
    the mesh has no face; `rms`, `mean` and `max` are those of the others (0 if none).
    """

    distances: Float[Array, " n"]
    mask: Bool[Array, " n"]

    @property
    def rms(self) -> Float[Array, ""]:
        """The root of the mean squared distance; gradient zero where it is zero."""
        square = masked_mean(jnp.where(self.mask, self.distances, 0) ** 2, self.mask)
        positive = square > 0
        return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0)

    @property
    def mean(self) -> Float[Array, ""]:
        """The mean distance."""
        return masked_mean(self.distances, self.mask)

    @property
    def max(self) -> Float[Array, ""]:
        """The largest distance."""
        return jnp.max(jnp.where(self.mask, self.distances, 0), initial=0)


def chamfer(a: PointCloud | Array, b: PointCloud | Array) -> Float[Array, ""]:
    """CD-L1: half of (mean distance of a to b + mean distance of b to a).

    In the unit of the points; infinite if one cloud is empty and the other is not.
    Differentiable in both. `a` and `b` are clouds or arrays [n, 3], of any sizes.

    Source: S. Peng et al., Shape As Points, 2021 (evaluation protocol).
    """
    there, back = match(a, b), match(b, a)
    return (there.mean() + back.mean()) / 2


def f_score(
    a: PointCloud | Array, b: PointCloud | Array, threshold: Float[Array, ""] | float
) -> Float[Array, ""]:
    """2 P R / (P + R): P the share of a within `threshold` of b, R that of b near a.

    In [0, 1]; the gradient is zero. Zero if a cloud is empty.

    Source: A. Knapitsch et al., Tanks and Temples, 2017, section 3.3.
    """
    return harmonic_mean(
        match(a, b).share_within(threshold), match(b, a).share_within(threshold)
    )


def normal_consistency(a: PointCloud, b: PointCloud) -> Float[Array, ""]:
    """The mean absolute cosine between the normals of nearest points, both ways halved.

    In [0, 1]; differentiable in the normals. Zero if a cloud is empty. Raises
    `GeometryError` where a cloud has no normals.
    """
    there, back = match(a, b), match(b, a)
    if there.cosines is None:
        must = "normal consistency needs normals on both clouds"
        fix = "Estimate normals, or sample a mesh with sample_surface."
        raise GeometryError(message(must, "a cloud without normals", fix))
    return (there.mean_cosine() + back.mean_cosine()) / 2


def hausdorff(a: PointCloud | Array, b: PointCloud | Array) -> Float[Array, ""]:
    """The largest distance of a point of one cloud to the nearest of the other.

    Infinite if one cloud is empty and the other is not.
    """
    return jnp.maximum(match(a, b).max(), match(b, a).max())


def match(a: PointCloud | Array, b: PointCloud | Array) -> Match:
    """For every point of a, the nearest point of b."""
    a, b = _as_cloud(a), _as_cloud(b)
    # A few points are sooner compared than sorted (and the program is much smaller).
    backend = BruteForce() if b.points.shape[0] <= _FEW else None
    index = build(b.points, b.mask, backend=backend)
    near = knn(index, a.points, 1, mask=a.mask)
    cosines = None
    if a.normals is not None and b.normals is not None:
        there = b.normals.at[near.indices[:, 0]].get(mode="fill", fill_value=0)
        dot = jnp.sum(safe_normalize(a.normals) * safe_normalize(there), axis=-1)
        cosines = jnp.where(a.mask, jnp.abs(dot), 0)
    return Match(near.distances[:, 0], cosines, a.mask)


def point_to_mesh(points: PointCloud | Array, mesh: TriangleMesh) -> PointToMesh:
    """The exact distance of every point to the surface, with `rms`, `mean` and `max`.

    `points` is a cloud or an array [n, 3]. Differentiable in points and vertices.
    """
    cloud = _as_cloud(points)
    mesh = jax.tree.map(jnp.asarray, mesh)
    closest = closest_on_mesh(mesh, cloud.points)
    return PointToMesh(closest.distances, closest.mask & cloud.mask)


def harmonic_mean(x, y):
    """2 x y / (x + y), 0 for x = y = 0."""
    return safe_divide(2 * x * y, x + y)


def _as_cloud(x) -> PointCloud:
    cloud = x if isinstance(x, PointCloud) else PointCloud(x)
    return jax.tree.map(jnp.asarray, cloud).washed()
