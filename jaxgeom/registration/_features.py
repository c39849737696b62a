"""Descriptors of the neighborhood of a point, and pairs of points whose match."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import (
    GeometryError,
    check_shape,
    message,
    safe_divide,
    safe_norm,
    safe_normalize,
)
from ..neighbors import Neighbors, build, knn
from ..shapes import PointCloud

_BINS = 11


class Matches(eqx.Module):
    """For every source row the target row that looks most like it.

    `mask` is True where there is one; elsewhere `indices` are m (one past the last
    target row) and `distances`, in feature space, infinite.
    """

    indices: Int[Array, " n"]
    distances: Float[Array, " n"]
    mask: Bool[Array, " n"]


def fpfh(
    cloud: PointCloud, *, radius: Float[Array, ""] | float, k: int = 64
) -> Float[Array, "n 33"]:
    """Fast point feature histograms [n, 33], which do not change under rigid motions.

    For every pair of a point and a neighbor three angles between the normals and the
    line that joins them are counted in 11 bins each, in percent of the neighbors: the
    simple histogram S. The feature is S(p) + the mean of S over the neighbors q with
    weights 1 / |p - q|^2. Each group of 11 numbers adds up to 200, or to zero for
    padding and for points without neighbors.

    **Arguments:**

    - `cloud`: with oriented normals; normals of zero length count as no neighbor.
    - `radius`: of the neighborhood, in the unit of the points; about five times the
      distance of neighboring points.
    - `k`: the most neighbors, the nearest ones.

    Counts have no derivative: features are constants under differentiation. Raises
    `GeometryError` for a cloud without normals.

    Source: Rusu, Blodow, Beetz 2009, Fast point feature histograms for 3D registration.
    """
    if cloud.normals is None:
        raise GeometryError(
            message(
                "features need oriented normals",
                "normals=None",
                "Call normals.estimate and orient_toward_viewpoint first.",
            )
        )
    # Histograms are piecewise constant.
    washed = jax.lax.stop_gradient(jax.tree.map(jnp.asarray, cloud.washed()))
    normals = safe_normalize(washed.normals)
    real = washed.mask & jnp.any(normals != 0, axis=1)
    index = build(washed.points, real)
    near = knn(
        index, washed.points, k + 1, mask=real, max_distance=radius, groups=index.groups
    )
    itself = near.indices == jnp.arange(real.shape[0])[:, None]
    near = eqx.tree_at(lambda x: x.mask, near, near.mask & ~itself)
    simple = _simple_histograms(washed.points, normals, near)
    return simple + _neighbor_mean(simple, near)


def _simple_histograms(points, normals, near: Neighbors):
    """The three histograms [n, 33] of every point, each in percent."""
    j = jnp.where(near.mask, near.indices, 0)
    # Coordinates apart: gathers of [n, k, 3] are several times slower.
    apart = lambda x: [x[:, d] for d in range(3)]
    there = lambda x: [x[:, d][j] for d in range(3)]
    here = lambda x: [c[:, None] for c in apart(x)]
    gap = [b - a for a, b in zip(here(points), there(points), strict=True)]
    angles, whole = _pair_angles(here(normals), there(normals), gap)
    use = near.mask & whole
    percent = safe_divide(100.0, jnp.sum(use, axis=1).astype(points.dtype))
    counts = [_histogram(unit, use) for unit in angles]
    return jnp.concatenate(counts, axis=1) * percent[:, None]


def _pair_angles(n1, n2, gap):
    """The three angles of pairs as numbers in [0, 1], and whether they exist."""
    length = jnp.sqrt(_dot(gap, gap))
    a1, a2 = (safe_divide(_dot(n, gap), length) for n in (n1, n2))
    # The frame stands on the point whose normal makes the smaller angle with the line.
    swap = jnp.abs(a1) < jnp.abs(a2)
    choose = lambda x, y: [jnp.where(swap, p, q) for p, q in zip(x, y, strict=True)]
    u, other = choose(n2, n1), choose(n1, n2)
    line = [jnp.where(swap, -g, g) for g in gap]
    v = _cross(line, u)
    size = jnp.sqrt(_dot(v, v))
    v = [safe_divide(c, size) for c in v]
    w = _cross(u, v)
    turn = jnp.arctan2(_dot(w, other), _dot(u, other))
    lean = _dot(v, other)
    slope = jnp.where(swap, -a2, a1)
    angles = turn / (2 * jnp.pi) + 0.5, (lean + 1) / 2, (slope + 1) / 2
    return angles, (length > 0) & (size > 0)


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def _cross(a, b):
    (ax, ay, az), (bx, by, bz) = a, b
    return [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]


def _histogram(unit, use):
    """How many numbers of each row of [n, k] fall into each bin of [0, 1]."""
    cell = jnp.clip(jnp.floor(unit * _BINS), 0, _BINS - 1).astype(jnp.int32)
    cell = jnp.where(use, cell, _BINS)
    columns = [jnp.sum(cell == b, axis=1) for b in range(_BINS)]
    return jnp.stack(columns, axis=1).astype(unit.dtype)


def _neighbor_mean(simple, near: Neighbors):
    """The mean of the neighbors' histograms, nearer ones counting more, in percent."""
    distance = jnp.where(near.mask, near.distances, 0)
    weight = safe_divide(1.0, distance**2)
    j = jnp.where(near.mask, near.indices, 0)

    def take(total, column):
        weight, j = column
        return total + weight[:, None] * simple[j], None

    total, _ = jax.lax.scan(take, jnp.zeros_like(simple), (weight.T, j.T))
    groups = total.reshape(-1, 3, _BINS)
    sums = jnp.sum(groups, axis=2, keepdims=True)
    return (100 * safe_divide(groups, sums)).reshape(simple.shape)


def match_features(
    source: Float[Array, "n f"],
    target: Float[Array, "m f"],
    *,
    source_mask: Bool[Array, " n"] | None = None,
    target_mask: Bool[Array, " m"] | None = None,
    mutual: bool = True,
    tile: int = 256,
) -> Matches:
    """For every source feature the nearest target feature.

    **Arguments:**

    - `source`, `target`: rows of features; those with `mask` False take no part.
    - `mutual`: keep a pair only if the source feature is also the nearest to the
      target feature.
    - `tile`: rows compared at once with all of the target.

    Distances are exact; which of two features equally far up to rounding is chosen is
    not. Indices are constants under differentiation. Raises `GeometryError` for shapes
    that do not agree.
    """
    check_shape("source", source, (None, None))
    check_shape("target", target, (None, source.shape[1]))
    source, target = jnp.asarray(source), jnp.asarray(target)
    n, m = source.shape[0], target.shape[0]
    source_mask = jnp.ones(n, bool) if source_mask is None else source_mask
    target_mask = jnp.ones(m, bool) if target_mask is None else target_mask
    check_shape("source_mask", source_mask, (n,))
    check_shape("target_mask", target_mask, (m,))
    # Which feature is nearest is piecewise constant.
    fixed = jax.lax.stop_gradient((source, target))
    there = _nearest(*fixed, target_mask, tile)
    mask = source_mask & (there < m)
    if mutual:
        back = _nearest(*fixed[::-1], source_mask, tile)
        mask = mask & (back.at[there].get(mode="clip") == jnp.arange(n))
    gap = source - target.at[there].get(mode="clip")
    distances = jnp.where(mask, safe_norm(jnp.where(mask[:, None], gap, 0)), jnp.inf)
    return Matches(jnp.where(mask, there, m), distances, mask)


def _nearest(queries, rows, mask, tile):
    """The index of the nearest row to every query; the number of rows if none."""
    m = rows.shape[0]
    half = jnp.where(mask, jnp.sum(rows**2, axis=1) / 2, jnp.inf)
    rows = jnp.where(mask[:, None], rows, 0)
    number = jnp.arange(m, dtype=jnp.int32)

    def nearest(query):
        excess = half - rows @ query
        # argmin is several times slower than two plain reductions.
        least = jnp.min(excess)
        found = jnp.min(jnp.where(excess == least, number, m))
        return jnp.where(least < jnp.inf, found, m)

    tile = max(1, min(tile, queries.shape[0]))
    return jax.lax.map(nearest, queries, batch_size=tile)
