"""Signs of normals."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import GeometryError, message, safe_divide, safe_normalize
from ..clouds import nearest_graph
from ..neighbors import Neighbors, build, knn
from ..neighbors._morton import bounds, morton_order
from ..shapes import PointCloud
from ._estimate import local_normals, unit
from ._winding import consistent_dipoles, gradient

# The first steps are on one point of four, and on no fewer than this.
_SHARE, _FEW = 4, 256


def orient_toward_viewpoint(
    cloud: PointCloud, viewpoint: Float[Array, "*n 3"]
) -> PointCloud:
    """The cloud with normals turned so that n . (viewpoint - x) >= 0.

    `viewpoint` is the position of the scanner: [3] for all points or [n, 3], one each.
    Raises `GeometryError` for a cloud without normals.
    """
    normals = _normals_of(cloud)
    toward = jnp.sum(normals * (jnp.asarray(viewpoint) - cloud.points), axis=-1)
    return cloud.with_normals(jnp.where((toward < 0)[:, None], -normals, normals))


def orient_consistently(
    cloud: PointCloud,
    *,
    k: int = 12,
    capacity: int = 4096,
    steps: int = 40,
    votes: int = 8,
) -> PointCloud:
    """The cloud with outward normals, without any viewpoint.

    For at most `capacity` points, spread evenly, dipoles are found that make the
    winding number 1/2 on the surface (see `_winding`): by `steps` iterations on a
    quarter of them, then a fifth as many, of cost capacity^2 each, on all. Every normal
    is turned along the gradient of their field, and then `votes` times to the side of
    the majority of its k neighbors. Normals that the cloud lacks are estimated from the
    k neighbors. Meant for closed surfaces and scans with moderate holes. Signs are
    constants under differentiation.
    """
    near = nearest_graph(cloud, k)
    normals = local_normals(cloud, near) if cloud.normals is None else cloud.normals
    washed = jnp.where(cloud.mask[:, None], jnp.asarray(normals), 0)
    # A sign is piecewise constant: it has no gradient.
    points, fixed = jax.lax.stop_gradient((cloud.washed().points, unit(washed)))
    outward = _outward(points, cloud.mask, capacity, steps)
    guess = jnp.sum(fixed * outward, axis=-1)
    sign = _majority(_signs(guess), fixed, jax.lax.stop_gradient(near), votes)
    return cloud.with_normals(normals * sign[:, None])


@partial(jax.jit, static_argnames=("capacity", "steps"))
def _outward(points, mask, capacity, steps):
    """The direction in which the winding number falls, at every point."""
    low, high = bounds(points, mask)
    side = jnp.max(high - low)
    # The published widths are for the cube [-1, 1]^3 shrunk by 1.1.
    unit_points = (points - (low + high) / 2) / jnp.where(side > 0, side, 1) * (2 / 1.1)
    order = morton_order(points, mask, low, high)
    total = jnp.sum(mask)

    def spread(size, count):
        """`count` of the points evenly along the curve, in `size` slots."""
        slot = jnp.arange(size)
        stride = total.astype(points.dtype) / jnp.maximum(count, 1)
        last = points.shape[0] - 1
        pick = order[jnp.clip((slot * stride).astype(jnp.int32), 0, last)]
        real = slot < count
        some = jnp.where(real[:, None], unit_points[pick], 0)
        return some, real, _spacing(some, real)

    size = min(capacity, points.shape[0])
    count = jnp.minimum(total, size)
    few = max(size // _SHARE, min(size, _FEW))
    # By the points that are there: padding must not matter.
    fewer = jnp.minimum(jnp.maximum(count // _SHARE, _FEW), count)
    some, real, width = spread(few, fewer)
    start = jnp.zeros_like(some)
    widths = (4 * width, width)
    coarse = consistent_dipoles(some, real, start, widths=widths, steps=steps)
    fine, there, spacing = spread(size, count)
    direction = safe_normalize(gradient(fine, some, coarse, width))
    # The same area, divided among more points.
    area = jnp.sum(jnp.linalg.norm(coarse, axis=-1)) / jnp.maximum(count, 1)
    start = area * direction * there[:, None]
    widths, steps = (2 * spacing, spacing), -(-steps // 5)
    dipoles = consistent_dipoles(fine, there, start, widths=widths, steps=steps)
    return gradient(unit_points, fine, dipoles, spacing)


def _spacing(points, real):
    """The typical distance of neighboring points."""
    near = knn(build(points, real), points, 2, mask=real)
    there = near.mask[:, 1]
    total = jnp.sum(jnp.where(there, near.distances[:, 1], 0))
    return safe_divide(total, jnp.sum(there).astype(points.dtype))


def _majority(sign, normals, near: Neighbors, votes: int):
    """Signs after rounds of voting; a vote counts n_i . n_j, fewer across an edge."""
    there = near.mask
    index = jnp.where(there, near.indices, 0)
    agree = jnp.einsum("nkd,nd->nk", normals[index], normals)
    agree = jnp.where(there, agree, 0)

    def round_(_, sign):
        return _signs(jnp.sum(agree * sign[index], axis=1))

    return jax.lax.fori_loop(0, votes, round_, sign)


def _signs(x: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.where(x < 0, -1, 1).astype(x.dtype)


def _normals_of(cloud):
    if cloud.normals is None:
        raise GeometryError(
            message(
                "the cloud must have normals",
                "normals=None",
                "Call normals.estimate first.",
            )
        )
    return jnp.asarray(cloud.normals)
