"""The learned road from points to a field: any trainable field, fitted to a cloud."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from .._core import (
    RESULTS,
    GeometryError,
    failure_where,
    first_failure,
    message,
)
from ..fields import AbstractField
from ..learning import Adam, SurfaceLoss, Trained, train
from ..shapes import PointCloud
from ..transforms import Similarity
from ._prepare import padded, unit_box


class FittedField(eqx.Module):
    """A field fitted to a cloud.

    - `field`: in the unit and the place of the points, negative inside; takes points of
      any dtype, and every query, extractor and renderer takes it.
    - `unit_field`: the same in the unit box, where it was trained: start here to go on.
    - `error`: the mean |f| over the points of the cloud, in their unit.
    - `losses` [num_steps]. `result`, `notes`: what happened.
    """

    field: AbstractField
    unit_field: AbstractField
    error: Float[Array, ""]
    losses: Float[Array, " s"]
    result: RESULTS
    notes: tuple[str, ...] = eqx.field(static=True, default=())


def fit_field(
    field: AbstractField,
    cloud: PointCloud | Float[Array, "n 3"],
    *,
    key: Key[Array, ""],
    loss: Callable | None = None,
    adam: Adam | None = None,
    rtol: float = 0.01,
    progress: Callable[[int, float], None] | None = None,
    throw: bool = True,
) -> FittedField:
    """The field trained until its surface goes through a cloud (host form).

    The cloud is checked and brought to the unit box (longest side 1, center 0) in
    double precision; `field` lives there. Without normals the surface alone is fitted,
    and the sphere at the start decides on the inside.

    **Arguments:**

    - `field`: what to train, such as `learning.NeuralField.siren(key=...)`; any field
      whose parameters are floating leaves.
    - `cloud`: a `PointCloud`, or points [n, 3] in any unit.
    - `key`: a typed key, used once: same key, same field.
    - `loss`: `learning.SurfaceLoss()` by default.
    - `adam`: `learning.Adam()` by default: number of steps and learning rate.
    - `rtol`: the fit has converged where `error` is at most `rtol` times the longest
      side.
    - `progress`: called as progress(steps done, loss) after every 100 steps.
    - `throw`: raise `GeometryError` where training diverged.

    **Statuses:** `diverged`; `not_converged` (a usable field that misses the points).
    Raises `GeometryError` for the clouds that `prepare` refuses.
    """
    ready = unit_box(cloud)
    unit = padded(bare(ready))
    loss = SurfaceLoss() if loss is None else loss
    out = train(field, loss, unit, key=key, adam=adam, progress=progress)
    error = _error(out.model, unit)
    result = first_failure(out.result, failure_to_reach(error, rtol))
    if throw:
        check_trained(out)
    return in_place(out.model, error, out.losses, result, ready)


def check_trained(out: Trained) -> None:
    """Raise `GeometryError` where training diverged."""
    if bool(out.result == RESULTS.diverged):
        raise GeometryError(
            message(
                "training must end with a finite loss below its start",
                f"{int(out.num_skipped)} of {out.losses.shape[0]} steps not finite, "
                f"last loss {float(out.losses[-1]):.3g}",
                "Lower Adam(rate=...), or pass throw=False to look at the field.",
            )
        )


def bare(ready) -> PointCloud:
    """The cloud without attributes."""
    return PointCloud(ready.cloud.points, ready.cloud.normals)


def failure_to_reach(error, rtol) -> RESULTS:
    """`not_converged` for an error above `rtol`, NaN included."""
    return failure_where(~(error <= rtol), RESULTS.not_converged)


def in_place(unit_field, error, losses, result, ready) -> FittedField:
    """A field of the unit box where the user's points are."""
    placed = unit_field.transformed(user_from_unit(ready))
    width = np.asarray(error, float) * ready.scale
    return FittedField(placed, unit_field, width, losses, result, ready.notes)


def mean_miss(field, cloud) -> Float[Array, ""]:
    """The mean |f| over the points of a cloud."""
    washed = cloud.washed()
    values = jnp.abs(jax.vmap(field)(washed.points))
    return jnp.sum(jnp.where(washed.mask, values, 0)) / jnp.sum(washed.mask)


_error = eqx.filter_jit(mean_miss)


def user_from_unit(ready) -> Similarity:
    """The way from the unit box to the user's points."""
    dtype = ready.cloud.points.dtype
    return Similarity(
        jnp.asarray(ready.scale, dtype),
        jnp.eye(3, dtype=dtype),
        jnp.asarray(ready.center, dtype),
    )
