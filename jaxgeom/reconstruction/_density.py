"""What the points say of the surface before it is known: area, noise, density.

The number of samples per volume, smoothed by a kernel of standard deviation s along
every axis, is D = (samples per area) / (sqrt(2 pi) s) at a point of a flat surface,
because the kernel's profile across the surface is a Gaussian at its peak. So the area
that one sample stands for is a = 1 / (sqrt(2 pi) s D).

The kernel: points are shared among the 8 nodes of a grid of twice the spacing, the
sums are smoothed by (1, 2, 1) / 4 along each axis, and read back trilinearly. Its
variance is 1/6 + 1/2 + 1/6 squared coarse spacings, s = 1.826 fine spacings. Where a
scan is too sparse for that kernel, the estimate of a coarser grid takes over.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._core import stage
from ..linear import coarse_shape, interpolate, prolong, smooth, splat

# Standard deviation of the kernel in spacings of the grid that it lives on.
_WIDTH = (5 / 6) ** 0.5
# A kernel is trusted when it holds about this many samples besides the one it is for.
_ENOUGH = 6.0
_PRIOR_NOISE = 0.5


class SampleGeometry(eqx.Module):
    """What each sample stands for, in units of grid cells.

    - `area`: [n], the surface area per sample, in squared spacings; 0 for padding.
    - `density`: [i, j, k], samples per squared spacing around the nodes of the grid of
      twice the spacing. It falls to zero over the width of the kernel where the surface
      was not seen.
    - `noise`: [], the standard deviation of the samples across the surface, spacings.
    """

    area: Float[Array, " n"]
    density: Float[Array, "i j k"]
    noise: Float[Array, ""]


def sample_geometry(
    q: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    real: Bool[Array, " n"],
    shape: tuple[int, int, int],
    *,
    levels: int = 0,
    token: Bool[Array, ""] | None = None,
) -> SampleGeometry:
    """The area and the noise of samples at node indices q of a grid of `shape`.

    **Arguments:**

    - `normals`: [n, 3], unit; `real`: [n], False for padding.
    - `levels`: how many grids beyond the first, each twice as coarse, the density is
      estimated on. The finest that holds enough samples around a point serves it.
    - `token`: see `jaxgeom._core.stage`.

    The noise is the scatter of n . (x - m) about its local mean, where m is the mean of
    the samples in the kernel: a plane gives 0, so does constant curvature.
    """
    area = density = None
    for level in reversed(range(1, levels + 2)):
        coarse, grid_shape = at_level(q, shape, level)
        count = splat(real.astype(q.dtype), coarse, grid_shape)
        total = smooth(count, token=token)
        here = _neighborhood(coarse, total, level)
        area = here.area if area is None else _blend(here.trust, here.area, area)
        density = _density(total, level, density, token)
    noise = _noise(coarse, normals, real, grid_shape, here, token)
    return SampleGeometry(jnp.where(real, area, 0.0), density, noise)


class _Neighborhood(eqx.Module):
    """The other samples around each sample, by the kernel of one grid level.

    `own` is the weight of the sample itself, `others` the sum over all others, `area`
    what one sample stands for in fine cells, `trust` in [0, 1] whether the kernel holds
    enough samples.
    """

    own: Float[Array, " n"]
    others: Float[Array, " n"]
    area: Float[Array, " n"]
    trust: Float[Array, " n"]


def _blend(trust, here, coarser):
    return trust * here + (1 - trust) * coarser


def _density(total, level, coarser, token):
    """Samples per squared fine spacing, from the sums of one grid and what the coarser
    grids say."""
    per_coarse_area = lambda total: (2 * jnp.pi) ** 0.5 * _WIDTH * total
    if coarser is None:
        return per_coarse_area(total) / 4.0**level
    around = prolong(coarser, total.shape, token=token)

    def blend(total, around):
        here = per_coarse_area(total)
        return _blend(_trust(here), here / 4.0**level, around)

    return stage(token, blend, total, around)


def _trust(density):
    """In [0, 1]: whether the kernel holds enough samples, at `density` per area."""
    return jnp.clip(4 * jnp.pi * _WIDTH**2 * density / _ENOUGH, 0.0, 1.0)


def at_level(q, shape, level):
    """Node indices and shape on the grid that is `level` times twice as coarse."""
    for _ in range(level):
        q, shape = (q - 0.5) / 2, coarse_shape(shape)
    return q, shape


def _neighborhood(q, total, level) -> _Neighborhood:
    own = _own_weight(q)
    # A stray sample far from all others stands for a few coarse cells at most: with
    # the area that its loneliness suggests it would outweigh the whole scan.
    others = jnp.maximum(interpolate(total, q) - own, own)
    density = (2 * jnp.pi) ** 0.5 * _WIDTH * others
    return _Neighborhood(own, others, 4.0**level / density, _trust(density))


def _own_weight(q):
    """The kernel of a sample at itself: prod_d (1 - t_d (1 - t_d)) / 2."""
    t = q - jnp.floor(q)
    return jnp.prod(0.5 - 0.5 * t * (1 - t), axis=-1)


def _noise(q, normals, real, shape, around, token):
    """The root mean square of the offsets from the local mean, in fine spacings.

    Means are over the other samples, and samples count as far as they have neighbors.
    A cloud too sparse to tell gets the prior, as if it were 0.2 % of the samples.
    """
    weights = real.astype(q.dtype)
    center = (jnp.asarray(shape, q.dtype) - 1) / 2

    def mean_of_others(w):
        total = interpolate(smooth(splat(weights * w, q, shape), token=token), q)
        return (total - around.own * w) / around.others

    # One after the other: a batched scatter is many times slower.
    mean = lax.map(mean_of_others, (q - center).T).T
    offset = jnp.sum(normals * (q - center - mean), axis=-1)
    weights = weights * jnp.maximum(2 * around.trust - 1, 0.0)
    scatter = (2 * (offset - mean_of_others(offset))) ** 2
    prior = 0.002 * jnp.sum(real)
    squares = jnp.sum(weights * jnp.where(weights > 0, scatter, 0.0))
    return jnp.sqrt((squares + prior * _PRIOR_NOISE**2) / (jnp.sum(weights) + prior))
