"""The scans of a ragged batch, each checked and in its unit box."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np

from .._core import RESULTS, GeometryError, message
from ..shapes import PointCloud, stack
from ._prepare import Prepared, Refused, unit_box


class Item(eqx.Module):
    """A scan in its unit box; `refusal` is the status of one that has no surface."""

    ready: Prepared
    refusal: RESULTS | None


def items_of(
    clouds: PointCloud,
    alone: str,
    notes: Callable[[PointCloud], list[str]] = lambda cloud: [],
) -> list[Item]:
    """The scans of a batch [b, n, 3] as `prepare` takes each, normals as they are.

    Points that are not finite are ignored. One that `prepare` refuses is an empty item
    with the text of the error as its note: a program runs on it, and no one looks at
    what comes out. `notes` finds more of them, and may refuse. Raises `GeometryError`
    for what is no batch, and names the function for a scan `alone`.
    """
    check_batch(clouds, alone)
    return [_item(clouds, i, notes) for i in range(clouds.points.shape[0])]


def check_batch(clouds: PointCloud, alone: str) -> None:
    """Raise `GeometryError` for what is no batch [b, n, 3]."""
    if clouds.points.ndim != 3:
        raise GeometryError(
            message(
                "clouds must be a batch of points [b, n, 3]",
                f"points of shape {tuple(clouds.points.shape)}",
                f"Make a batch with jaxgeom.stack, or call {alone}.",
            )
        )


def together(items: list[Item], size: int) -> PointCloud:
    """The clouds of the items as one batch of `size` points."""
    return stack([item.ready.cloud for item in items], capacity=size)


def _item(clouds, i, notes):
    cloud = jax.tree.map(lambda x: np.asarray(x[i]), clouds)
    there = cloud.mask & np.isfinite(cloud.points).all(axis=1)
    cloud = eqx.tree_at(lambda c: c.mask, cloud, there)
    try:
        ready = unit_box(cloud)
        more = (*ready.notes, *notes(ready.cloud))
        return Item(dataclasses.replace(ready, notes=more), None)
    except Refused as refused:
        empty = jax.tree.map(np.zeros_like, cloud)
        where = (np.zeros(3), 1.0, cloud.points.dtype)
        ready = Prepared(empty, None, *where, (str(refused),))
        return Item(ready, refused.status)
