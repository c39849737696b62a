"""What the k nearest points tell of a place: spacing, frame, curvature."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core import GeometryError, message, safe_divide
from ..neighbors import AbstractBackend, AbstractIndex, Neighbors, build, knn
from ..shapes import PointCloud
from ._frames import frames


def nearest_graph(
    cloud: PointCloud,
    k: int,
    *,
    backend: AbstractBackend | None = None,
    index: AbstractIndex | None = None,
    rows: Int[Array, " m"] | None = None,
) -> Neighbors:
    """The k nearest points [n, k] of every point of a cloud, itself among them.

    `backend` finds them, see `neighbors.build`; or `index`, where that of the points is
    built already. `rows` are the points that ask [m, k] (n for none), if not all:
    successive ones should lie together. Status and masks are those of `neighbors.knn`;
    padding finds nothing.
    """
    points = cloud.washed().points
    if index is None:
        index = build(points, cloud.mask, backend=backend)
    elif backend is not None or index.points.shape != points.shape:
        raise GeometryError(
            message(
                "an index must be that of the points, and goes without a backend",
                f"backend {backend}, an index of {index.points.shape[0]} points for "
                f"{points.shape[0]}",
                "Pass the index that was built of this cloud, or a backend.",
            )
        )
    if rows is None:
        return knn(index, points, k, mask=cloud.mask, groups=index.groups)
    asking, there = (
        jnp.asarray(x).at[rows].get(mode="fill", fill_value=0)
        for x in (points, cloud.mask)
    )
    group = jnp.arange(rows.shape[0], dtype=jnp.int32)[None]
    return knn(index, asking, k, mask=there, groups=group)


def centered(cloud: PointCloud, near: Neighbors):
    """The neighbors [n, k, 3] about their mean, zero where missing; and the mean."""
    there = near.mask
    points = jnp.asarray(cloud.washed().points)
    shifted = points[jnp.where(there, near.indices, 0)] - points[:, None]
    shifted = jnp.where(there[..., None], shifted, 0)
    count = jnp.maximum(jnp.sum(there, axis=1), 1).astype(shifted.dtype)
    mean = jnp.sum(shifted, axis=1) / count[:, None]
    gaps = jnp.where(there[..., None], shifted - mean[:, None], 0)
    return gaps, points + mean


class PrincipalFrames(eqx.Module):
    """The principal axes of neighborhoods.

    `centers` [n, 3] are the means, `variances` [n, 3] those along the unit `axes`
    [n, 3, 3] (columns), least first: the first axis is the normal. `mask` is False
    where there are fewer than three neighbors; there everything is zero.
    """

    centers: Float[Array, "n 3"]
    variances: Float[Array, "n 3"]
    axes: Float[Array, "n 3 3"]
    mask: Bool[Array, " n"]


def principal_frames(
    cloud: PointCloud, *, k: int = 16, backend: AbstractBackend | None = None
) -> PrincipalFrames:
    """The axes in which the k nearest points (itself among them) spread least to most.

    Eigenvectors and eigenvalues of sum_j (x_j - c)(x_j - c)^T / k. Variances and
    centers are differentiable in the points, the axes are constants.
    """
    near = nearest_graph(cloud, k, backend=backend)
    gaps, centers = centered(cloud, near)
    count = jnp.sum(near.mask, axis=1)
    spread = jnp.einsum("nki,nkj->nij", gaps, gaps)
    size = jax.lax.stop_gradient(jnp.trace(spread, axis1=1, axis2=2))
    size = jnp.where(size > 0, size, 1)[:, None, None]
    # To first order eigenvalues do not depend on the eigenvectors.
    axes = frames(jax.lax.stop_gradient(spread) / size)[1]
    total = jnp.einsum("nia,nij,nja->na", axes, spread, axes)
    some = count >= 3
    variances = total / jnp.maximum(count, 1).astype(total.dtype)[:, None]
    wash = lambda x: jnp.where(some.reshape(-1, *(1,) * (x.ndim - 1)), x, 0)
    return PrincipalFrames(
        wash(centers), wash(jnp.maximum(variances, 0)), wash(axes), some
    )


def surface_variation(
    cloud: PointCloud, *, k: int = 16, backend: AbstractBackend | None = None
) -> Float[Array, " n"]:
    """The least variance of the neighbors over the sum of all three, 0 to 1/3.

    A measure of curvature that needs no orientation: zero on a plane, about
    (kappa r / 4)^2 on a smooth surface seen at radius r. Zero for padding.

    Source: M. Pauly et al., Efficient simplification of point-sampled surfaces, 2002.
    """
    variances = principal_frames(cloud, k=k, backend=backend).variances
    return safe_divide(variances[:, 0], jnp.sum(variances, axis=1))


def density(
    cloud: PointCloud, *, k: int = 8, backend: AbstractBackend | None = None
) -> Float[Array, " n"]:
    """Points per area of a surface: k / (pi r^2), r the distance to the k-th other.

    Zero for padding and where there are fewer others, or all of them coincide.
    """
    near = nearest_graph(cloud, k + 1, backend=backend)
    some = near.mask[:, k]
    reach = jnp.where(some, near.distances[:, k], 0)
    return safe_divide(jnp.asarray(k, reach.dtype), np.pi * reach**2)
