"""Neighbors by scipy's k-d tree on the host: for a CPU, and quick to compile."""

from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._backends import AbstractBackend, AbstractIndex, usable

# Trees of the last few sets of points, so that a loop of searches grows each one once.
_REMEMBERED = 4


class HostIndex(AbstractIndex):
    """Points whose tree lives on the host."""

    points: Float[Array, "n 3"]
    mask: Bool[Array, " n"]
    workers: int = eqx.field(static=True)
    groups: None = None

    def search(self, queries, active, k, reach, groups):
        points, mask = usable(self.points, self.mask)
        shape = jax.ShapeDtypeStruct((queries.shape[0], k), jnp.int32)
        find = lambda *arrays: _find(*map(np.asarray, arrays), k, self.workers)
        return jax.pure_callback(
            find, shape, points, mask, queries, active, reach, vmap_method="sequential"
        )


class HostTree(AbstractBackend):
    """A k-d tree of scipy, asked from inside jit by `jax.pure_callback`.

    A choice for the CPU only: on an accelerator every search would wait for copies to
    the host and back. `jax.vmap` searches one item after the other. The tree is grown
    at the first search and remembered for the next ones among the same points.
    `workers` is the number of threads, -1 for all.
    """

    workers: int = eqx.field(static=True, default=-1)

    def build(self, points, mask):
        return HostIndex(points, mask, self.workers)


def _find(points, mask, queries, active, reach, k, workers):
    out = np.full((len(queries), k), len(points), np.int32)
    real = np.flatnonzero(mask)
    active = active & (reach >= 0)
    if len(real) == 0 or not active.any():
        return out
    tree = _grown(points[real].tobytes(), points.dtype)
    # scipy wants distances below its bound, and `reach` is a rounded square.
    slack = 1 + 2 * np.finfo(points.dtype).eps
    bound = np.sqrt(reach[active], dtype=np.float64) * slack
    bound = bound + np.finfo(points.dtype).tiny
    ranks = np.arange(1, k + 1)
    distances, near = tree.query(
        queries[active], ranks, distance_upper_bound=bound.max(), workers=workers
    )
    near = np.where(distances < bound[:, None], near, len(real))
    out[active] = np.append(real, len(points))[near]
    return out


@lru_cache(maxsize=_REMEMBERED)
def _grown(data: bytes, dtype):
    # Here, so that importing the package does not wait for scipy.
    from scipy.spatial import cKDTree

    return cKDTree(np.frombuffer(data, dtype).reshape(-1, 3))
