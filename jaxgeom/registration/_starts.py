"""Alignment from many starts at once; the best one is kept."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import RESULTS
from ..shapes import PointCloud, TriangleMesh
from ..transforms import Affine, Rigid, Similarity
from ._icp import icp
from ._report import Registration
from ._scene import Method, PreparedTarget, prepare_target


def icp_from_many(
    source: PointCloud,
    target: PointCloud | TriangleMesh | PreparedTarget,
    starts: Rigid | Similarity | Affine,
    *,
    method: Method | None = None,
    max_distance: Float[Array, ""] | float = jnp.inf,
    batch_size: int | None = None,
    **settings,
) -> Registration:
    """The best of the alignments by `icp` from each of the given starts.

    With g the largest distance, the best is where the mean over the source of
    min(d^2, g^2) is least, d the distance to its target point: a pose that covers more
    of the source wins over one that fits a small part well. Without g it is where the
    root mean square residual is least. Successful alignments come before all others.

    **Arguments:** as `icp`, and

    - `starts`: batched transforms [b].
    - `batch_size`: how many run side by side, None for all; memory grows with it.

    The choice among the starts is a constant under differentiation, the chosen
    alignment has the derivative of `icp`.
    """
    chosen = Method() if method is None else method
    if not isinstance(target, PreparedTarget):
        target = prepare_target(target, chosen.correspondence)

    def run(start):
        return icp(
            source,
            target,
            init=start,
            method=method,
            max_distance=max_distance,
            **settings,
        )

    b = starts.translation.shape[0]
    found = jax.lax.map(run, starts, batch_size=batch_size or b)
    gate = jnp.asarray(max_distance, found.rmse.dtype)
    missed = gate**2 - found.fitness * (gate**2 - found.distance**2)
    cost = jnp.where(jnp.isfinite(gate), missed, found.rmse**2)
    good = found.result == RESULTS.successful
    # Infinities would make all failures equal; a failure costs more than any success.
    cost = jnp.where(jnp.isnan(cost), jnp.inf, cost)
    order = jnp.lexsort((cost, ~good))
    return jax.tree.map(lambda x: x[order[0]], found)
