"""Values at scattered points extended to every node of a grid (push and pull)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import safe_divide, stage
from ..linear import prolong, restrict, splat


def spread(
    values: Float[Array, "n c"],
    q: Float[Array, "n 3"],
    real: Bool[Array, " n"],
    shape: tuple[int, int, int],
    *,
    token: Bool[Array, ""] | None = None,
) -> Float[Array, "x y z c"]:
    """Values [n, c] at node indices q as a field on all nodes [x, y, z, c].

    Weighted sums are pushed to ever coarser grids; on the way back every node keeps its
    own mean as far as it has samples, and takes the rest from the coarser grid: a
    smooth extension whose reach adapts to the gaps. Gortler et al. (1996), "The
    Lumigraph", section 3.4.
    """
    weights = real.astype(values.dtype)
    count = splat(weights, q, shape)
    totals = [splat(weights * column, q, shape) for column in values.T]
    return jnp.stack(_push_pull(count, totals, token), axis=-1)


def _push_pull(count, totals, token):
    """The extended mean of every channel."""
    if max(count.shape) <= 2:
        return [safe_divide(total, count) for total in totals]
    coarse_count = restrict(count, token=token)
    coarse_totals = [restrict(total, token=token) for total in totals]
    around = _push_pull(coarse_count, coarse_totals, token)
    finer = [prolong(c, count.shape, token=token) for c in around]
    return [
        stage(token, _pull, count, total, outside)
        for total, outside in zip(totals, finer, strict=True)
    ]


def _pull(count, total, outside):
    trust = jnp.clip(count, 0, 1)
    return trust * safe_divide(total, count) + (1 - trust) * outside
