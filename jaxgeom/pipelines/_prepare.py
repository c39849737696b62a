"""From whatever the user has to a clean oriented cloud in a unit box (host)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import RESULTS, GeometryError, bucket, message
from ..normals import LocalPlanes
from ..shapes import PointCloud, stack

_FEWEST = 4
_FLAT = 1e-6


class Refused(GeometryError):
    """A cloud of which no surface can be made; `status` says so in a batch."""

    def __init__(self, status: RESULTS, text: str):
        GeometryError.__init__(self, text)
        self.status = status


class Prepared(eqx.Module):
    """A cloud in the unit box with the way back: x_user = scale * x + center.

    `center` and `scale` are float64 on the host; `dtype` is that of the user's points;
    `notes` say in words what was estimated, ignored or looks odd.
    """

    cloud: PointCloud
    weights: Float[Array, " n"] | None
    center: np.ndarray
    scale: float
    dtype: np.dtype
    notes: tuple[str, ...] = eqx.field(static=True)


def prepare(cloud, *, weights=None, orientation=None) -> Prepared:
    """The user's points checked, centered in double precision, and oriented.

    **Arguments:**

    - `cloud`: a `PointCloud` or an array of points [n, 3].
    - `weights`: [n] nonnegative confidence, or None.
    - `orientation`: how missing normals are found, `normals.LocalPlanes()` (planes of
      16 neighbors) by default, or `normals.WindingConsistency()`.

    Raises `GeometryError` for fewer than 4 points, points that are not finite, points
    that all coincide or lie on a line, flat clouds without normals, and normals of
    which most are zero.
    """
    ready = unit_box(cloud, weights=weights)
    oriented, more = _with_normals(ready.cloud, orientation or LocalPlanes())
    notes = (*ready.notes, *more)
    where = (ready.center, ready.scale, ready.dtype)
    return Prepared(oriented, ready.weights, *where, notes)


def unit_box(cloud, *, weights=None) -> Prepared:
    """As `prepare`, but missing normals stay missing, and unusable ones stay."""
    cloud = cloud if isinstance(cloud, PointCloud) else PointCloud(_points_of(cloud))
    weights = _checked_weights(cloud, weights)
    keep = np.asarray(cloud.mask)
    weights = None if weights is None else weights[keep]
    cloud = cloud.trim()
    check_points(cloud.points)
    points = np.asarray(cloud.points, np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    center, scale = (low + high) / 2, float((high - low).max())
    notes = _check_extent(points - center, scale, cloud.normals is not None)
    dtype = jax.dtypes.canonicalize_dtype(cloud.points.dtype)
    unit = ((points - center) / scale).astype(dtype)
    boxed = PointCloud(unit, _cast(cloud.normals, dtype), None, cloud.attributes)
    return Prepared(boxed, weights, center, scale, cloud.points.dtype, tuple(notes))


def padded(cloud: PointCloud) -> PointCloud:
    """The cloud padded to its bucket: clouds of about one size share a program."""
    batch = stack([cloud], capacity=bucket(cloud.points.shape[0]))
    return jax.tree.map(lambda x: jnp.asarray(x[0]), batch)


def _points_of(points):
    points = np.asarray(points)
    if points.dtype == object or points.ndim != 2 or points.shape[1] != 3:
        raise GeometryError(
            message(
                "points must be an array of shape [n, 3]",
                f"shape {points.shape} and dtype {points.dtype}",
                "Pass x, y, z in three columns.",
            )
        )
    return points


def _checked_weights(cloud, weights):
    if weights is None:
        return None
    weights = np.asarray(weights)
    if weights.shape != cloud.mask.shape or not (weights >= 0).all():
        raise GeometryError(
            message(
                "weights must be nonnegative, one for each point",
                f"shape {weights.shape} for {cloud.mask.shape[0]} points",
                "Pass an array [n] of confidences.",
            )
        )
    return weights


def _cast(normals, dtype):
    return None if normals is None else np.asarray(normals).astype(dtype)


def check_points(points) -> None:
    """Raise `Refused` for too few points, or points that are not finite."""
    if points.shape[0] < _FEWEST:
        raise Refused(
            RESULTS.too_few_points,
            message(
                f"a surface needs at least {_FEWEST} points",
                f"{points.shape[0]}",
                "Check the file, or the mask of the cloud.",
            ),
        )
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        raise Refused(
            RESULTS.nonfinite_input,
            message(
                "points must be finite",
                f"{bad.sum()} of {bad.size} hold NaN or infinity, the first in row "
                f"{int(np.argmax(bad))}",
                "Mask them: PointCloud(points, normals, mask).",
            ),
        )


def _check_extent(centered, scale, has_normals):
    if scale == 0:
        raise Refused(
            RESULTS.degenerate_input,
            message(
                "points must not all coincide",
                f"{len(centered)} equal points",
                "Check the units and the columns of the file.",
            ),
        )
    spread = np.linalg.svd(
        (centered - centered.mean(axis=0)) / scale, compute_uv=False
    ) / np.sqrt(len(centered))
    if spread[1] < _FLAT:
        raise Refused(
            RESULTS.degenerate_input,
            message(
                "points must not lie on one line",
                f"width {spread[1] * scale:.2g} at length {spread[0] * scale:.2g}",
                "A surface needs points in at least two directions.",
            ),
        )
    if spread[2] >= _FLAT:
        return []
    if not has_normals:
        raise Refused(
            RESULTS.degenerate_input,
            message(
                "points without normals must not lie in one plane",
                f"thickness {spread[2] * scale:.2g} at width {spread[1] * scale:.2g}",
                "Give normals: they say which side is outside.",
            ),
        )
    return ["all points lie in one plane: the surface is a thin sheet; use trim"]


def _with_normals(cloud, orientation):
    notes = notes_on_normals(cloud)
    if cloud.normals is not None:
        return cloud, notes
    oriented = _orient(orientation, padded(cloud))
    normals = np.asarray(oriented.normals)[: len(cloud.points)]
    return PointCloud(cloud.points, normals, None, cloud.attributes), notes


def notes_on_normals(cloud) -> list[str]:
    """What is estimated or ignored; `Refused` where most normals cannot be used."""
    if cloud.normals is None:
        return ["normals were estimated and oriented outward"]
    length = np.linalg.norm(np.nan_to_num(cloud.normals), axis=1)
    bad = (length == 0) | ~np.isfinite(cloud.normals).all(axis=1)
    if bad.mean() > 0.5:
        raise Refused(
            RESULTS.zero_normals,
            message(
                "most normals must be finite and not zero",
                f"{bad.sum()} of {bad.size} are not",
                "Leave the normals out: they are estimated then.",
            ),
        )
    if not bad.any():
        return []
    return [f"{bad.sum()} of {bad.size} points have no usable normal: ignored"]


@eqx.filter_jit
def _orient(orientation, cloud):
    return orientation(cloud)
