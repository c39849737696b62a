"""A field for every scan of a ragged batch, all trained at once."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from .._core import bucket, first_failure
from ..fields import AbstractField
from ..learning import Adam, SurfaceLoss, train_jit
from ..shapes import PointCloud, stack
from ._devices import gathered, on_each, placed
from ._fit_field import FittedField, bare, failure_to_reach, in_place, mean_miss
from ._items import items_of


def fit_many(
    field: AbstractField,
    clouds: PointCloud,
    *,
    key: Key[Array, ""],
    loss: Callable | None = None,
    adam: Adam | None = None,
    rtol: float = 0.01,
) -> list[FittedField]:
    """A field trained to go through each scan of a ragged batch, in one compiled call.

    Every scan starts from `field` and is that of `fit_field` with the key
    `jax.random.split(key, b)[i]`; all train side by side, divided among the local
    devices.

    **Arguments:** as `fit_field`, and

    - `clouds`: scans as one batch [b, n, 3] with masks, of `jaxgeom.stack`; all have
      normals, or none. Points that are not finite are ignored.
    - `key`: a typed key, used once.

    **Statuses:** those of `fit_field`, `diverged` included, and for clouds that it
    refuses that of the error (`too_few_points`, `degenerate_input`), its text among the
    `notes`, and `field` as it came. Raises `GeometryError` for clouds that are no
    batch.
    """
    scans = items_of(clouds, "fit_field")
    unit = stack(
        [bare(scan.ready) for scan in scans], capacity=bucket(clouds.points.shape[1])
    )
    draws = jax.random.key_data(jax.random.split(key, len(scans)))
    items, mesh = placed((unit, draws))
    loss = SurfaceLoss() if loss is None else loss
    adam = Adam() if adam is None else adam
    start = jax.tree.map(lambda x: jnp.asarray(x) if eqx.is_array(x) else x, field)
    found = _train(items, (start, loss, adam, jnp.asarray(rtol)), mesh)
    found = gathered(found, len(scans))
    rows = (jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(scans)))
    return [_finished(*row, start, scan) for row, scan in zip(rows, scans, strict=True)]


@eqx.filter_jit
def _train(items, given, mesh):
    """The trained numbers, errors, losses and statuses."""
    arrays, fixed = eqx.partition(given, eqx.is_array)

    def run(items, arrays):
        field, loss, adam, rtol = eqx.combine(arrays, fixed)

        def one(item):
            cloud, draw = item
            key = jax.random.wrap_key_data(draw)
            out = train_jit(field, loss, cloud, key=key, adam=adam)
            error = mean_miss(out.model, cloud)
            result = first_failure(out.result, failure_to_reach(error, rtol))
            return eqx.filter(out.model, eqx.is_array), error, out.losses, result

        return jax.vmap(one)(items)

    return on_each(run, mesh)(items, arrays)


def _finished(numbers, error, losses, result, start, item) -> FittedField:
    model = eqx.combine(numbers, start)
    if item.refusal is not None:
        model, result = start, item.refusal
    return in_place(model, error, losses, result, item.ready)
