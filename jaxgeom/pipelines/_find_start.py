"""The rough alignment of two scans of which nothing is known but the unit."""

import equinox as eqx
import jax
from jaxtyping import Array, Float, Key

from .._core import RESULTS, GeometryError, message
from ..registration import GlobalStart, align_features
from ..shapes import PointCloud
from ._frames import Frames, checked, oriented

# The side of a voxel as a share of the median longest side of the two scans.
_COARSE = 1 / 40


def find_start(
    source: PointCloud | Float[Array, "n 3"],
    target: PointCloud | Float[Array, "m 3"],
    *,
    viewpoints: Float[Array, "*b 3"] | None = None,
    voxel_size: float | None = None,
    key: Key[Array, ""] | None = None,
    throw: bool = True,
) -> GlobalStart:
    """A rough target_from_source from features, to start `register` with (host form).

    **Arguments:**

    - `source`, `target`: clouds or points in one unit; missing normals are estimated.
    - `viewpoints`: [3] or [2, 3], the scanner in the frames of source and target, which
      estimated normals are turned toward; without it they are turned outward.
    - `voxel_size`: of the points that are described, in the unit of the points; 1/40 of
      the median longest side by default.
    - `key`: of the random samples; the answer is a function of the data and the key.
    - `throw`: raise `GeometryError` for a status that is not success.

    **Statuses:** those of `align_features`.
    """
    scans = [checked(scan, i) for i, scan in enumerate((target, source))]
    frames = Frames.of(scans)
    views = frames.viewpoints(None if viewpoints is None else viewpoints[::-1])
    batch, _ = oriented(frames.to_unit(scans), views)
    coarse = _COARSE if voxel_size is None else voxel_size / frames.scale
    found = _align(batch, coarse, jax.random.key(0) if key is None else key)
    if throw and found.result != RESULTS.successful:
        raise GeometryError(
            message(
                "the scans must share a region whose features are found in both",
                f"{RESULTS[found.result]} ({int(found.num_inliers)} pairs agree)",
                "Give normals or viewpoints, another voxel_size or key, or a start.",
            )
        )
    pose = frames.user_pose(found.target_from_source)
    return eqx.tree_at(
        lambda f: (f.target_from_source, f.rmse),
        found,
        (pose, found.rmse * frames.scale),
    )


@eqx.filter_jit
def _align(batch, coarse, key) -> GlobalStart:
    target, source = (jax.tree.map(lambda x, i=i: x[i], batch) for i in (0, 1))
    return align_features(source, target, voxel_size=coarse, key=key)
