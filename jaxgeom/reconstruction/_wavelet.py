"""Wavelet reconstruction: the Haar coefficients of the solid from oriented points.

By the divergence theorem a coefficient of the indicator chi is a sum over the samples,

    int chi psi = sum_p a_p n_p . F(x_p),    div F = psi,

and F has the support of psi where psi has mean zero along the axis of F. In a cell of
2^l nodes a side, t in [0, 1]^3 its local coordinates, psi_e = prod_{d in e} h(t_d) with
h = 1 below 1/2 and -1 above, and F averages over d in e the fields whose component d is
H(t_d) prod_{e less d} h, H(t) = min(t, 1 - t). No system is solved.

Source: Manson, Petrova, Schaefer, Streaming surface reconstruction using wavelets,
SGP 2008.
"""

import itertools
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from .._core import stage
from ..linear import smooth
from ._measured import Measured, without_steps
from ._solution import FieldSolution

# Which axes a wavelet alternates along; none for the mean.
_KINDS = tuple(itertools.product((0, 1), repeat=3))
_SIGNS = np.array([[1, 1], [1, -1]])


class Wavelet(eqx.Module):
    """Haar wavelet reconstruction (2008): the fastest, without solving anything.

    Sums over the samples only: gaps of the scan stay jagged, as nothing is minimised
    there. `smoothing`: how often the result is smoothed by (1, 2, 1) / 4 (static); Haar
    functions are steps. `levels`: as for `ScreenedPoisson`.
    """

    smoothing: int = eqx.field(static=True, default=2)
    levels: int | None = eqx.field(static=True, default=None)

    def __call__(self, cloud, grid, *, weights=None, token=None) -> FieldSolution:
        """The field of `cloud` on `grid`: -1/2 inside, +1/2 outside, roughly.

        Arguments as `screened_poisson`. **Statuses:** `too_few_points`,
        `zero_normals`, `outside_grid` (samples ignored), `nonfinite_input`.
        """
        seen = Measured.of(cloud, grid, weights, self.levels, token)
        # An area vector in units of the nodes along each axis.
        vectors = seen.normals * (grid.spacing / seen.unit) * seen.strength[:, None]
        values = 0.5 - indicator(seen.q, vectors, grid.shape)
        for _ in range(self.smoothing):
            values = stage(token, smooth, values)
        return seen.answer(without_steps(values), jnp.zeros((), values.dtype))


def indicator(
    q: Float[Array, "n 3"], vectors: Float[Array, "n 3"], shape: tuple[int, int, int]
) -> Float[Array, "x y z"]:
    """The means of chi (1 inside) over the cells around the nodes of a grid.

    `vectors`: area times outward normal, in spacings; zero for padding.
    """
    depth = math.ceil(math.log2(max(shape)))
    t = (q + 0.5) / 2**depth
    mean = jnp.sum(vectors * (t - 0.5)) / (3 * 4.0**depth)
    values = mean.reshape(1, 1, 1)
    for level in reversed(range(1, depth + 1)):
        values = _halved(values, (q + 0.5) / 2**level, vectors / 4.0**level)
    return values[: shape[0], : shape[1], : shape[2]]


def _halved(means, t, vectors):
    """The means over the eight children of each cell, from those over the cells."""
    m = means.shape[0]
    cell = jnp.clip(jnp.floor(t).astype(jnp.int32), 0, m - 1)
    t = t - cell
    index = (cell[:, 0] * m + cell[:, 1]) * m + cell[:, 2]
    fluxes = jnp.stack([_flux(kind, t, vectors) for kind in _KINDS[1:]])
    sums = lax.map(
        lambda w: jnp.zeros(m**3, w.dtype).at[index].add(w, mode="promise_in_bounds"),
        fluxes,
    )
    parts = jnp.concatenate([means.reshape(1, -1), sums]).reshape(2, 2, 2, m, m, m)
    signs = jnp.asarray(_SIGNS, parts.dtype)
    finer = jnp.einsum("abcxyz,ai,bj,ck->xiyjzk", parts, signs, signs, signs)
    return finer.reshape(2 * m, 2 * m, 2 * m)


def _flux(kind, t, vectors):
    """n_p . F for the wavelet that alternates along the axes `kind`."""
    step = jnp.where(t < 0.5, 1, -1).astype(t.dtype)
    hat = jnp.minimum(t, 1 - t)
    axes = [d for d in range(3) if kind[d]]
    terms = [
        vectors[:, d] * hat[:, d] * math.prod([step[:, o] for o in axes if o != d])
        for d in axes
    ]
    return sum(terms) / len(axes)
