"""Scans in frames of their own: checked, in one unit near the origin, with normals."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core import GeometryError, message
from ..normals import estimate, orient_consistently, orient_toward_viewpoint
from ..shapes import PointCloud, stack
from ..transforms import Rigid
from ._prepare import check_points

_NEIGHBORS = 16


class Frames(eqx.Module):
    """x_user = scale x_unit + center, with a center for every scan (float64)."""

    centers: np.ndarray
    scale: float

    @staticmethod
    def of(scans) -> "Frames":
        points = [np.asarray(scan.points, np.float64) for scan in scans]
        ends = np.array([[x.min(axis=0), x.max(axis=0)] for x in points])
        scale = float(np.median(np.max(ends[:, 1] - ends[:, 0], axis=1)))
        if scale == 0:
            raise GeometryError(
                message(
                    "scans must have an extent",
                    "scans whose points all coincide",
                    "Check the units and the columns of the files.",
                )
            )
        return Frames(ends.mean(axis=1), scale)

    def to_unit(self, scans) -> PointCloud:
        """The stacked scans about the origin, with side about one."""
        dtype = jnp.zeros(()).dtype
        unit = [
            PointCloud(
                ((np.asarray(s.points, np.float64) - c) / self.scale).astype(dtype),
                None if s.normals is None else np.asarray(s.normals, dtype),
            )
            for s, c in zip(scans, self.centers, strict=True)
        ]
        return stack(unit)

    def viewpoints(self, viewpoints):
        """Scanner positions [b, 3] in the unit frames, or None."""
        if viewpoints is None:
            return None
        given = np.broadcast_to(np.asarray(viewpoints, np.float64), self.centers.shape)
        return (given - self.centers) / self.scale

    def user_poses(self, poses) -> Rigid:
        """c_0 + s (R (x - c_i) / s + t), with the first scan's frame as the world."""
        turn = _orthonormal(np.asarray(poses.rotation, np.float64))
        shift = self.centers[0] + self.scale * np.asarray(poses.translation, np.float64)
        return Rigid(turn, shift - np.einsum("bij,bj->bi", turn, self.centers))

    def user_pose(self, pose) -> Rigid:
        """A motion from the second scan onto the first, in the user's coordinates."""
        identity = Rigid.identity(pose.translation.dtype)
        both = jax.tree.map(lambda a, b: np.stack([a, b]), identity, pose)
        moved = self.user_poses(both)
        # The first scan lies in its own frame: only its center was moved away.
        return jax.tree.map(lambda x: x[1], moved)

    def unit_poses(self, poses) -> Rigid:
        """The inverse of `user_poses`, relative to the first scan."""
        turn = np.asarray(poses.rotation, np.float64)
        shift = np.asarray(poses.translation, np.float64)
        middle = np.einsum("bij,bj->bi", turn, self.centers) + shift
        shift = ((middle - shift[0]) @ turn[0] - self.centers[0]) / self.scale
        dtype = jnp.zeros(()).dtype
        turn = np.einsum("ji,bjk->bik", turn[0], turn)
        return Rigid(jnp.asarray(turn, dtype), jnp.asarray(shift, dtype))


def _orthonormal(matrices):
    """Single-precision rotations made orthonormal in double precision."""
    u, _, v = np.linalg.svd(matrices)
    return u @ v


def checked(scan, number: int) -> PointCloud:
    """The real points of a scan; `GeometryError` names the scan that is no cloud."""
    scan = scan if isinstance(scan, PointCloud) else PointCloud(scan)
    scan = scan.trim()
    try:
        check_points(scan.points)
    except GeometryError as error:
        raise GeometryError(f"scan {number}: {error}") from None
    return scan


@eqx.filter_jit
def _with_estimates(batch, viewpoints):
    def one(cloud, viewpoint):
        cloud = estimate(cloud, k=_NEIGHBORS)
        if viewpoint is None:
            return orient_consistently(cloud)
        return orient_toward_viewpoint(cloud, viewpoint)

    if viewpoints is None:
        return jax.lax.map(lambda cloud: one(cloud, None), batch)
    return jax.lax.map(lambda pair: one(*pair), (batch, viewpoints))


def oriented(batch: PointCloud, viewpoints):
    """The stacked scans with normals, and notes on where these come from."""
    batch = jax.tree.map(jnp.asarray, batch)
    if batch.normals is not None:
        return batch, ()
    if viewpoints is None:
        note = "normals were estimated and oriented outward, without a viewpoint"
        return _with_estimates(batch, None), (note,)
    batch = _with_estimates(batch, jnp.asarray(viewpoints, batch.points.dtype))
    return batch, ("normals were estimated and oriented toward the viewpoints",)
