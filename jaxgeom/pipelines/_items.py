"""The scans of a ragged batch, each checked and in its unit box."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

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
    weights: Float[Array, "b n"] | None = None,
) -> list[Item]:
    """The scans of a batch [b, n, 3] as `prepare` takes each, normals as they are.

    Points that are not finite are ignored. One that `prepare` refuses is an empty item
    with the text of the error as its note: a program runs on it, and no one looks at
    what comes out. `notes` finds more of them, and may refuse; `weights` are those of
    the points. Raises `GeometryError` for what is no batch, and names the function for
    a scan `alone`.
    """
    check_batch(clouds, alone)
    if weights is not None and np.shape(weights) != clouds.mask.shape:
        raise GeometryError(
            message(
                "weights must be one for each point of the batch, padding included",
                f"shape {np.shape(weights)} for points {clouds.points.shape}",
                "Pad them with zeros to the size that jaxgeom.stack gave.",
            )
        )
    return [_item(clouds, weights, i, notes) for i in range(clouds.points.shape[0])]


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


def weights_together(items: list[Item], size: int) -> Float[Array, "b n"] | None:
    """The weights of the items, zero for padding; None where they have none."""
    given = [item.ready.weights for item in items]
    if any(weights is None for weights in given):
        return None
    dtype = items[0].ready.cloud.points.dtype
    return np.stack([np.pad(w, (0, size - len(w))) for w in given]).astype(dtype)


def _item(clouds, weights, i, notes):
    cloud, weights = jax.tree.map(lambda x: np.asarray(x[i]), (clouds, weights))
    there = cloud.mask & np.isfinite(cloud.points).all(axis=1)
    cloud = eqx.tree_at(lambda c: c.mask, cloud, there)
    try:
        ready = unit_box(cloud, weights=weights)
        more = (*ready.notes, *notes(ready.cloud))
        return Item(dataclasses.replace(ready, notes=more), None)
    except Refused as refused:
        empty = jax.tree.map(np.zeros_like, cloud)
        where = (np.zeros(3), 1.0, cloud.points.dtype)
        ready = Prepared(empty, weights, *where, (str(refused),))
        return Item(ready, refused.status)
