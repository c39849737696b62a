"""Several clouds as one."""

from collections.abc import Callable, Sequence

import jax.numpy as jnp

from .._core import GeometryError, message
from ..shapes import PointCloud
from ..transforms import Rigid


def merge(
    clouds: Sequence[PointCloud], transforms: Sequence[Rigid | Callable] | None = None
) -> PointCloud:
    """All clouds in one, each moved by its transform.

    `transforms` [b] map the frame of each cloud to the common one (identity without
    them); normals turn along. Padding stays padding. All clouds carry the same normals
    and attributes. Raises `GeometryError` for an empty list, different numbers, or
    clouds that differ in what they carry.
    """
    if not clouds:
        raise GeometryError(
            message("merge needs at least one cloud", "none", "Pass a list of clouds.")
        )
    if transforms is not None and len(transforms) != len(clouds):
        must, given = "every cloud needs one transform", f"{len(transforms)}"
        given = f"{given} for {len(clouds)} clouds"
        raise GeometryError(message(must, given, "Pass as many transforms as clouds."))
    carried = {(c.normals is not None, tuple(sorted(c.attributes))) for c in clouds}
    if len(carried) > 1:
        must = "merged clouds must all carry the same normals and attributes"
        given = f"(has normals, attributes) = {sorted(carried)}"
        raise GeometryError(message(must, given, "Drop what only some of them have."))
    if transforms is not None:
        clouds = [t(cloud) for t, cloud in zip(transforms, clouds, strict=True)]
    join = lambda *rows: jnp.concatenate([jnp.asarray(x) for x in rows])
    normals = None
    if clouds[0].normals is not None:
        normals = join(*(c.normals for c in clouds))
    attributes = {
        name: join(*(c.attributes[name] for c in clouds))
        for name in clouds[0].attributes
    }
    points, mask = (join(*(getattr(c, x) for c in clouds)) for x in ("points", "mask"))
    return PointCloud(points, normals, mask, attributes)
