"""Normals from the local plane of the k nearest points."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core import GeometryError, message, safe_divide, safe_norm, safe_normalize
from ..clouds import centered, frames, nearest_graph
from ..neighbors import AbstractBackend, AbstractIndex, Neighbors, build
from ..shapes import PointCloud


def estimate(
    cloud: PointCloud,
    *,
    k: int = 16,
    backend: AbstractBackend | None = None,
    index: AbstractIndex | None = None,
    axis: str | None = None,
) -> PointCloud:
    """The cloud with unit normals: the direction in which k neighbors spread least.

    n = the eigenvector of the smallest eigenvalue of sum_j (x_j - c)(x_j - c)^T, over
    the k nearest points (itself included) with mean c. The sign is arbitrary: orient
    with `orient_toward_viewpoint` or `orient_consistently`. Where the neighbors are
    fewer than three, or coincide, or lie on a line, the normal is zero. Differentiable
    in the points; the neighbors are constants, and the gradient is zero where the
    smallest eigenvalue is not simple. `backend` finds the neighbors, see
    `neighbors.build`; or `index`, where that of the points is built already.

    Within `jax.shard_map`, where every device has the whole cloud, `axis` names devices
    that share the work: each finds the normals of a part, and all have all of them.
    Raises `GeometryError` for an `axis` that names none.

    Source: Hoppe et al. 1992, Surface reconstruction from unorganized points, 3.1.
    """
    if axis is None:
        near = nearest_graph(cloud, k, backend=backend, index=index)
        return cloud.with_normals(local_normals(cloud, near))
    if index is None:
        clean = cloud.washed()
        index, backend = build(clean.points, clean.mask, backend=backend), None
    rows = _share(index, axis)
    near = nearest_graph(cloud, k, backend=backend, index=index, rows=rows)
    part = local_normals(cloud, near)
    rows, part = jax.lax.all_gather((rows, part), axis, tiled=True)
    normals = jnp.zeros((len(cloud.points), 3), part.dtype)
    return cloud.with_normals(normals.at[rows].set(part, mode="drop"))


def _share(index: AbstractIndex, axis: str) -> Int[Array, " m"]:
    """The rows of the points that fall to this device; n for none."""
    try:
        devices = jax.lax.axis_size(axis)
    except NameError:
        raise GeometryError(
            message(
                "axis must name devices of a jax.shard_map around the call",
                repr(axis),
                "Leave it out on one device.",
            )
        ) from None
    n = index.points.shape[0]
    groups = jnp.arange(n) if index.groups is None else index.groups
    rows = jnp.pad(groups.reshape(-1), (0, -groups.size % devices), constant_values=n)
    return rows.reshape(devices, -1)[jax.lax.axis_index(axis)]


def plane_residual(cloud: PointCloud, *, k: int = 16) -> Float[Array, " n"]:
    """The rms distance [n] of the k nearest points to their best plane.

    A measure of noise: about sigma sqrt(1 - 3/k) for Gaussian noise sigma, plus the
    part of the curvature. Zero for padding.
    """
    near = nearest_graph(cloud, k)
    there = near.mask
    gaps, _ = centered(cloud, near)
    normals = local_normals(cloud, near)
    height = jnp.where(there, jnp.einsum("nkd,nd->nk", gaps, normals), 0)
    count = jnp.maximum(jnp.sum(there, axis=1), 1).astype(height.dtype)
    return safe_norm(height) / jnp.sqrt(count)


def local_normals(cloud: PointCloud, near: Neighbors) -> Float[Array, "m 3"]:
    """The unit normals [m, 3] of the planes through given neighborhoods [m, k]."""
    # Axis by axis and neighbors first, which a CPU reads faster.
    there = near.mask.T
    rows, count = jnp.where(there, near.indices.T, 0), jnp.sum(there, axis=0)
    only = lambda x: jnp.where(there, x, 0)
    # Summed row by row: XLA on a CPU takes up to three times as long for `jnp.sum`.
    mean = lambda x: sum(x) / jnp.maximum(count, 1).astype(x.dtype)
    columns = [x[rows] for x in jnp.asarray(cloud.washed().points).T]
    gaps = [only(x - x[0]) for x in columns]
    gaps = jnp.stack([only(gap - mean(gap)) for gap in gaps])
    # Neighborhoods of any size become of order 1, so that squares keep their digits.
    size = jax.lax.stop_gradient(jnp.max(jnp.abs(gaps), axis=(0, 1)))
    gaps = gaps / jnp.where(size > 0, size, 1)
    spread = jnp.stack([jnp.stack([sum(a * b) for b in gaps]) for a in gaps])
    return smallest_direction(jnp.moveaxis(spread, -1, 0))


@jax.custom_jvp
def smallest_direction(matrix: Float[Array, "*n 3 3"]) -> Float[Array, "*n 3"]:
    """The unit eigenvector of the smallest eigenvalue; zero where it is not simple.

    dn = sum_i v_i (v_i . dM n) / (l_0 - l_i), and zero for equal eigenvalues, where
    the derivative of `eigh` is NaN.
    """
    return _smallest(*frames(matrix))


@smallest_direction.defjvp
def _smallest_direction_jvp(primals, tangents):
    (matrix,), (change,) = primals, tangents
    values, vectors = frames(matrix)
    normal = _smallest(values, vectors)
    turned = jnp.einsum("...ij,...j->...i", change, normal)
    gaps = values[..., :1] - values[..., 1:]
    rounding = 8 * jnp.finfo(values.dtype).eps * values[..., 2:]
    gaps = jnp.where(-gaps > rounding, gaps, 0)
    others = vectors[..., 1:]
    amounts = safe_divide(jnp.einsum("...ji,...j->...i", others, turned), gaps)
    return normal, jnp.einsum("...ji,...i->...j", others, amounts)


def _smallest(values, vectors):
    """The first vector, if the two largest eigenvalues are positive beyond rounding."""
    plane = values[..., 1] > 32 * jnp.finfo(values.dtype).eps * values[..., 2]
    return vectors[..., 0] * plane[..., None]


def unit(normals: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    """Normals of length one; zero stays zero."""
    return safe_normalize(normals)
