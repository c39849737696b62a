"""Tangent planes of the graph of a field, fitted in cells and in cells of an octree.

The graph w = f(x) has at the sample x_i the tangent plane w = f_i + g_i . (x - x_i).
The point (x, w) nearest to the planes of a cell, each weighted with the square of its
slope, is where the graph has a crease or a corner:

    E(x, w) = sum_i s_i (w - f_i - g_i . (x - x_i))^2,    s_i = 1 / (1 + |g_i|^2).

With y = x - c, c a center, and b_i = f_i - g_i . (x_i - c), the best w for a given y is
b + g . y, b and g being the weighted means, and what is left of E over S = sum s_i is

    C + 2 r . y + y . H y,    H, r, C the weighted covariances of (g_i, b_i):

the planes of `_qef.py`, with -r. About a center moved by d, b_i grows by g_i . d: b by
g . d, r by H d and C by 2 r . d + d . H d. The moments of a union add up as means and
covariances do, so that a cell of the octree needs those of its eight parts only.

Schaefer and Warren (2004), section 3; the sums: Chan, Golub and LeVeque (1983).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._hermite import CLEARANCE
from ._qef import PAIRS, Planes, minimize, times

_STEPS = 4
# The corners of a cell, the last axis first.
_CORNERS = np.indices((2, 2, 2)).reshape(3, 8).T


class Moments(eqx.Module):
    """Of the planes of every cell, about its center, in units of the widest side of a
    grid cell: S, and the means and covariances that E consists of.

    Coordinates first; `right` is r, `spread` is C.
    """

    weight: Float[Array, "*c"]
    slope: Float[Array, "3 *c"]
    height: Float[Array, "*c"]
    normal: Float[Array, "6 *c"]
    right: Float[Array, "3 *c"]
    spread: Float[Array, "*c"]


def of_planes(slope, height) -> Moments:
    """The moments of eight planes per cell, with slopes [3, 8, ...] and heights at the
    center."""
    zero = jnp.zeros_like(height)
    weight = 1 / (1 + sum(g * g for g in slope))
    none = lambda n: jnp.stack([zero] * n)
    return joined(Moments(weight, slope, height, none(6), none(3), zero))


def moved(moments: Moments, shift) -> Moments:
    """The moments about a center moved by `shift`, three numbers."""
    turned = times(moments.normal, shift)
    dot = lambda a, b: sum(x * y for x, y in zip(a, b, strict=True))
    spread = moments.spread + 2 * dot(moments.right, shift) + dot(turned, shift)
    height = moments.height + dot(moments.slope, shift)
    right = moments.right + jnp.stack(turned)
    return Moments(moments.weight, moments.slope, height, moments.normal, right, spread)


def joined(parts: Moments) -> Moments:
    """The moments of the planes of eight parts about one center; the parts lie along
    the fourth axis from the end."""
    over = lambda x: jnp.sum(x, axis=-4)
    weight = over(parts.weight)
    share = parts.weight / weight
    slope, height = over(share * parts.slope), over(share * parts.height)
    g, b = parts.slope - slope[:, None], parts.height - height
    # Entry by entry: jaxlib 0.10.2 on CPUs gets the sums of stacked products wrong.
    rows = zip(parts.normal, PAIRS, strict=True)
    normal = jnp.stack([over(share * (n + g[i] * g[j])) for n, (i, j) in rows])
    right = over(share * (parts.right + g * b))
    spread = over(share * (parts.spread + b * b))
    return Moments(weight, slope, height, normal, right, spread)


def of_cells(values, slopes, size) -> Moments:
    """The moments of the eight corners of every cell, about its center.

    `values` [x, y, z] and `slopes` [3, x, y, z] at the nodes of cells of this size.
    """

    def corners(x):
        cut = lambda step: tuple(
            slice(s, n - 1 + s) for s, n in zip(step, x.shape[-3:], strict=True)
        )
        return jnp.stack([x[(..., *cut(step))] for step in _CORNERS], axis=-4)

    slope = corners(slopes)
    shift = _to_center(size)
    return of_planes(
        slope, corners(values) + sum(slope[d] * shift[d] for d in range(3))
    )


def of_blocks(moments: Moments, size) -> Moments:
    """The moments of blocks of two by two by two cells of this size.

    A layer without partner is left out.
    """

    def parts(x):
        *lead, nx, ny, nz = x.shape
        x = x[..., : nx // 2 * 2, : ny // 2 * 2, : nz // 2 * 2]
        x = x.reshape(*lead, nx // 2, 2, ny // 2, 2, nz // 2, 2)
        x = jnp.moveaxis(x, (-5, -3, -1), (-6, -5, -4))
        return x.reshape(*lead, 8, nx // 2, ny // 2, nz // 2)

    return joined(moved(jax.tree.map(parts, moments), _to_center(size)))


def _to_center(size):
    """From the eight corners of a cell, or the centers of its parts, to its center."""
    away = [(0.5 - _CORNERS[:, d]) * size[d] for d in range(3)]
    return [a[:, None, None, None] for a in away]


def feature(moments: Moments, size, weight) -> tuple[Float[Array, "3 *c"], Array]:
    """The point of every cell where its planes meet best, from the center, and the root
    mean square distance of the graph from them there."""
    rows = lambda x: x.reshape(len(x), -1)
    planes = Planes(
        jnp.zeros_like(rows(moments.slope)),
        rows(moments.normal),
        -rows(moments.right),
        rows(moments.slope),
    )
    half = (0.5 - CLEARANCE) * size
    y = minimize(planes, -half, half, weight, _STEPS)
    bent = times(planes.normal, y)
    error = moments.spread.reshape(-1)
    for d in range(3):
        error = error + y[d] * (bent[d] - 2 * planes.right[d])
    shape = moments.weight.shape
    error = jnp.sqrt(jnp.maximum(error, 0)).reshape(shape)
    return y.reshape(3, *shape), error


def heights(moments: Moments, y) -> Float[Array, "*c"]:
    """The value w of the fit at the points y from the centers."""
    return moments.height + sum(g * p for g, p in zip(moments.slope, y, strict=True))
