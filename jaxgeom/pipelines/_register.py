"""Two scans of one thing in, the motion that lays one on the other out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import RESULTS, GeometryError, bucket, message
from ..registration import Registration
from ..shapes import PointCloud
from ..transforms import Affine, Rigid, Similarity
from ._pyramid import (
    Pyramid,
    align,
    choose_voxel_size,
    level_rooms,
    without_sparse_levels,
)

_FEWEST = 6


class MeanAligned(eqx.Module):
    """Start with the centroid of the source on that of the target, unturned."""


def register(
    source: PointCloud | Float[Array, "n 3"],
    target: PointCloud | Float[Array, "m 3"],
    *,
    voxel_size: float | None = None,
    init: Rigid | Similarity | Affine | MeanAligned | None = None,
    pyramid: Pyramid | None = None,
    throw: bool = True,
) -> Registration:
    """The motion target_from_source that lays a scan on another (host form).

    Checks the clouds, centers them in double precision, chooses the voxel size, and
    aligns coarse to fine by `icp`: by default points to planes, a `Tukey` kernel
    whose width follows the residuals, and a shrinking largest distance.

    **Arguments:**

    - `source`, `target`: a `PointCloud`, or points [n, 3], in one unit. Points that are
      not finite are ignored. Normals are used where both have them, and estimated
      otherwise.
    - `voxel_size`: side of the finest voxels; by default such that a voxel with points
      holds two on average.
    - `init`: the transform to start from (identity by default), or `MeanAligned()`.
    - `pyramid`: levels and method; coarse levels with few points are left out.
    - `throw`: raise `GeometryError` for a status that is not success.

    The transform is in double precision. **Statuses:** those of `icp`, for the finest
    level. Raises `GeometryError` for arrays of wrong shape or too few points.
    """
    pyramid = Pyramid() if pyramid is None else pyramid
    clouds = [_checked(source, "source"), _checked(target, "target")]
    center = np.asarray(clouds[1].points, np.float64).mean(axis=0)
    points = [np.asarray(cloud.points, np.float64) - center for cloud in clouds]
    if voxel_size is None:
        voxel_size = max(choose_voxel_size(p) for p in points)
    start = _start(init, *points, center)
    pair = _padded(clouds, points)
    dtype = pair[0].points.dtype
    pyramid = without_sparse_levels(points, voxel_size, pyramid)
    rooms = level_rooms(points, voxel_size, pyramid)
    found = _run(
        *pair, jnp.asarray(voxel_size, dtype), as_dtype(start, dtype), rooms, pyramid
    )
    if throw:
        _raise_for(found)
    moved = conjugated(as_dtype(found.target_from_source, np.float64), -center)
    return eqx.tree_at(lambda r: r.target_from_source, found, moved)


def register_jit(
    source: PointCloud,
    target: PointCloud,
    *,
    voxel_size: Float[Array, ""],
    rooms: tuple[int, ...],
    init: Rigid | Similarity | Affine | None = None,
    pyramid: Pyramid | None = None,
) -> Registration:
    """The alignment at static sizes: pure, for your own `jax.jit`, `vmap` and `grad`.

    Derivatives reach points and normals; they are those of the minimum on the finest
    level at its pairs.

    **Arguments:** as `register`, and

    - `source`, `target`: of equal size [n, 3] and with normals both or neither; pad
      the shorter and mask it.
    - `voxel_size`: side of the finest voxels.
    - `rooms`: the capacity of every level, such as of `level_rooms`.
    """
    pyramid = Pyramid() if pyramid is None else pyramid
    start = Rigid.identity(source.points.dtype) if init is None else init
    return align(source, target, voxel_size, start, rooms, pyramid)


_run = eqx.filter_jit(align)


def _checked(cloud, name) -> PointCloud:
    """The finite points of a cloud, on the host."""
    cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(cloud)
    finite = masked(cloud).trim()
    if len(finite.points) < _FEWEST:
        raise GeometryError(
            message(
                f"the {name} must have at least {_FEWEST} finite points",
                f"{len(finite.points)} of {len(cloud.points)}",
                "Check the file, its units, or the mask of the cloud.",
            )
        )
    return finite


def masked(cloud) -> PointCloud:
    """The cloud on the host, with points and normals that are not finite masked."""
    points = np.asarray(cloud.points)
    mask = np.asarray(cloud.mask) & np.isfinite(points).all(axis=-1)
    normals = cloud.normals
    if normals is not None:
        normals = np.asarray(normals)
        mask = mask & np.isfinite(normals).all(axis=-1)
    # A batch has no constructor: its fields are replaced.
    where = lambda c: (c.points, c.normals, c.mask, c.attributes)
    none = lambda x: x is None
    return eqx.tree_at(where, cloud, (points, normals, mask, {}), is_leaf=none)


def _start(init, source, target, center):
    """The transform to start from, between points about the center."""
    if init is None:
        return Rigid(np.eye(3), np.zeros(3))
    if isinstance(init, MeanAligned):
        return Rigid(np.eye(3), target.mean(axis=0) - source.mean(axis=0))
    return conjugated(as_dtype(init, np.float64), center)


def conjugated(transform, center):
    """The transforms in coordinates about `center`, batched or not."""
    linear, shift = _parts(transform)
    turned = np.einsum("...ij,...j->...i", linear, center)
    where = lambda t: t.translation
    return eqx.tree_at(where, transform, shift + turned - center)


def _parts(transform):
    if isinstance(transform, Affine):
        return transform.coefficients, transform.translation
    scale = transform.scale if isinstance(transform, Similarity) else np.ones(())
    return scale[..., None, None] * transform.rotation, transform.translation


def as_dtype(transform, dtype):
    """The transform with numbers of another precision, on the host."""
    return jax.tree.map(lambda x: np.asarray(x).astype(dtype), transform)


def _padded(clouds, points):
    """Both clouds at the size of one bucket, so that similar pairs share a program."""
    dtype = jax.dtypes.canonicalize_dtype(clouds[0].points.dtype)
    size = bucket(max(len(p) for p in points))
    normals = all(cloud.normals is not None for cloud in clouds)
    pad = lambda x: np.pad(x.astype(dtype), ((0, size - len(x)), (0, 0)))
    return [
        PointCloud(
            jnp.asarray(pad(p)),
            jnp.asarray(pad(cloud.normals)) if normals else None,
            jnp.arange(size) < len(p),
        )
        for cloud, p in zip(clouds, points, strict=True)
    ]


def _raise_for(found):
    """Raise for a status that is not success, in words."""
    if found.result == RESULTS.successful:
        return
    raise GeometryError(
        message(
            "the alignment must end with success",
            f"{RESULTS[found.result]} ({int(found.num_matches)} pairs, "
            f"{100 * float(found.fitness):.0f} % of the source)",
            "Pass a better init or another voxel_size, or throw=False to look at it.",
        )
    )
