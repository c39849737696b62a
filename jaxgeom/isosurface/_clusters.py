"""Merge neighboring patches of a dual mesh, as long as its topology stays.

The patches are polygons that tile the surface: their corners are the cut edges of the
grid, their sides the segments in its faces. Merging patches into clusters, and giving
each cluster one vertex, keeps the dual mesh a manifold of the same kind if

1. every cluster is a disk: connected across sides, and with corners - sides + patches
   = 1. A disk that touches itself in a corner has less;
2. two clusters meet in one piece, if at all: the corners that both have, less the sides
   between them, are 1. Then no edge of the mesh is there twice, and a diagonal of a
   quad is no edge;
3. three or more other clusters meet around every cluster: at least three corners have
   three different clusters.

Clusters grow in octree cells of 2, 4, 8, ... grid cells: those that are connected in
one cell are tried as one. Candidates that break a rule or the tolerance fall apart
again, until none is left that does; all rules hold then, since they did before.

Ju, Losasso, Schaefer and Warren (2002) merge cells of an octree by their error;
Schaefer, Ju and Warren (2007) patches, by counting corners on the faces of its cells.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._core import components
from ..shapes import Grid
from ._dual import Dual
from ._dual_contouring import STEPS
from ._hermite import CLEARANCE, Hermite
from ._patches import Patches, corner_indices
from ._qef import Planes, minimize, times

_SIDES = ((0, 1), (1, 2), (2, 3), (3, 0))
_PAIRS = (*_SIDES, (0, 2), (1, 3))


class Clusters(eqx.Module):
    """For every patch the first patch of its cluster, and the level of the octree
    cell, 2^level grid cells wide, in which the cluster lies."""

    label: Int[Array, " v"]
    level: Int[Array, " v"]


class _Patches(eqx.Module):
    """What the search for clusters looks at: constants of the patches."""

    cell: Int[Array, "3 v"]
    number: Int[Array, " v"]
    free: Bool[Array, " v"]


def find_clusters(
    dual: Dual, hermite: Hermite, planes: Planes, grid: Grid, weight, tolerance, levels
) -> Clusters:
    """Clusters whose vertex is within `tolerance` of the planes of all its crossings.

    `planes` are those of the patches, in units of the widest side of a cell, as is the
    tolerance. Patches at the sides of the grid are left as they are.
    """
    patches = dual.patches
    v = patches.node.shape[0]
    cell = corner_indices(patches.node, grid.shape).T
    known = _Patches(cell, jnp.sum(patches.held, axis=0), _free(dual))
    quads = jnp.where(dual.held, dual.quads, v)
    start = jnp.arange(v, dtype=jnp.int32)
    clusters = Clusters(start, jnp.zeros_like(start))

    def grow(clusters, level):
        tried = Clusters(
            _candidates(known, quads, level), jnp.full_like(clusters.level, level)
        )
        merged = merge_planes(planes, tried, patches, grid)
        vertex = place_clusters(merged, tried, patches, grid, weight)
        far = _misfit(vertex, tried, hermite, dual, grid) > tolerance
        bad = far | ~_are_disks(tried.label, quads, known)
        label = _settle(clusters.label, tried.label, bad, quads, known.free)
        merged = label != clusters.label
        merged = merged.at[label].max(merged)[label]
        return Clusters(label, jnp.where(merged, level, clusters.level)), None

    return lax.scan(grow, clusters, jnp.arange(1, levels + 1, dtype=jnp.int32))[0]


def _free(dual: Dual) -> Bool[Array, " v"]:
    """Patches with a quad at every corner, of which no neighbor lacks one."""
    patches = dual.patches
    whole = patches.complete & jnp.all(~patches.held | dual.held[patches.edge], axis=0)
    around = [whole.at[q].get(mode="clip") for q in dual.quads]
    sound = dual.held & around[0] & around[1] & around[2] & around[3]
    return whole & jnp.all(~patches.held | sound[patches.edge], axis=0)


def _candidates(known: _Patches, quads, level) -> Int[Array, " v"]:
    """The first patch of all that are connected in a cell of this level."""
    v = known.free.shape[0]
    block = known.cell >> level
    first, second = [], []
    for i, j in _SIDES:
        a, b = quads[i], quads[j]
        same = known.free.at[a].get(mode="clip") & known.free.at[b].get(mode="clip")
        for row in block:
            same = same & (row.at[a].get(mode="clip") == row.at[b].get(mode="clip"))
        same = same & (a < v)
        first.append(jnp.where(same, a, v))
        second.append(jnp.where(same, b, v))
    return components(v, jnp.concatenate(first), jnp.concatenate(second))


def place_clusters(
    merged: Planes, clusters: Clusters, patches: Patches, grid: Grid, weight
) -> Float[Array, "3 v"]:
    """The vertex of every cluster at its first patch, from the corner of the cell of
    that patch, in units of the widest side of a cell."""
    size = grid.spacing / jnp.max(grid.spacing)
    width = (1 << clusters.level).astype(size.dtype)
    high = [(width - CLEARANCE) * s for s in size]
    vertex = minimize(merged, CLEARANCE * size, high, weight, STEPS)
    return vertex - _shift(clusters, patches, grid)


def _shift(clusters: Clusters, patches: Patches, grid: Grid) -> Float[Array, "3 v"]:
    """The cell of each patch from the corner of the octree cell of its cluster."""
    size = grid.spacing / jnp.max(grid.spacing)
    cell = corner_indices(patches.node, grid.shape).T
    return (cell & ((1 << clusters.level) - 1)) * size[:, None]


def merge_planes(
    planes: Planes, clusters: Clusters, patches: Patches, grid: Grid
) -> Planes:
    """The planes of every cluster at its first patch, from the corner of its cell."""
    label, number = clusters.label, jnp.sum(patches.held, axis=0)
    number = number.astype(planes.mean.dtype)
    place = planes.mean + _shift(clusters, patches, grid)
    total = lambda x: jnp.zeros_like(x).at[:, label].add(x)
    count = jnp.maximum(total(number[None])[0], 1)
    mean = total(number * place) / count
    right = planes.right + jnp.stack(times(planes.normal, place - mean[:, label]))
    average = lambda x: total(number * x) / count
    return Planes(mean, average(planes.normal), average(right), total(planes.direction))


def _misfit(vertex, clusters: Clusters, hermite: Hermite, dual: Dual, grid: Grid):
    """The largest distance of a vertex from the planes of its cluster."""
    patches = dual.patches
    size = grid.spacing / jnp.max(grid.spacing)
    shift = _shift(clusters, patches, grid)
    local = (vertex + shift)[:, clusters.label] - shift

    def take(worst, slot):
        edge, code, held = slot
        along, axis = hermite.t[edge], code & 3
        gap = 0
        for d in range(3):
            corner = (code >> (2 + d) & 1).astype(along.dtype)
            place = jnp.where(axis == d, along, corner) * size[d]
            gap = gap + hermite.normals[:, d][edge] * (local[d] - place)
        return jnp.maximum(worst, jnp.where(held, jnp.abs(gap), 0)), None

    slots = (patches.edge, patches.code, patches.held)
    worst = lax.scan(take, jnp.zeros_like(vertex[0]), slots)[0]
    return jnp.zeros_like(worst).at[clusters.label].max(worst)


def _new_at(labels) -> list[Bool[Array, " e"]]:
    """Whether each corner of a quad has a label that those before it have not."""
    first = [jnp.ones_like(labels[0], bool)]
    for i in range(1, 4):
        first.append(
            jnp.all(jnp.stack([labels[i] != labels[j] for j in range(i)]), axis=0)
        )
    return first


def _labels_of(label, quads) -> list[Int[Array, " e"]]:
    """The labels around every quad; v where there is no quad."""
    v = label.shape[0]
    return [label.at[q].get(mode="fill", fill_value=v) for q in quads]


def _are_disks(label, quads, known: _Patches) -> Bool[Array, " v"]:
    """Whether corners - sides + patches is 1, at the first patch of each cluster."""
    around = _labels_of(label, quads)
    total = jnp.zeros(label.shape[0], jnp.int32)
    # Twice the corners, and a side between two patches of one cluster from either end.
    for here, new in zip(around, _new_at(around), strict=True):
        total = total.at[here].add(2 * new.astype(jnp.int32), mode="drop")
    for i, j in _SIDES:
        inner = (around[i] == around[j]).astype(jnp.int32)
        total = total.at[around[i]].add(inner, mode="drop")
    # Every patch has as many sides as corners; those inside were counted twice.
    own = 2 * (1 - known.number.astype(jnp.int32))
    return total.at[label].add(own) == 2


def _settle(before, tried, bad, quads, free) -> Int[Array, " v"]:
    """The candidates that keep the rules; where they do not, what was before."""
    v = tried.shape[0]
    merged = jnp.zeros(v, bool).at[tried].max(before != tried)

    def again(state):
        rejected, _ = state
        around = _labels_of(jnp.where(rejected[tried], before, tried), quads)
        new = _new_at(around)
        lonely = free & _have_few_corners(around, new, v)
        # One that was there before can only blame what was merged around it.
        blamed = _around(lonely & ~(merged & ~rejected), around, v)
        more = rejected | (merged & (lonely | blamed | _meet_often(around, new, v)))
        return more, jnp.any(more != rejected)

    start = (merged & bad, jnp.asarray(True))
    rejected = lax.while_loop(lambda s: s[1], again, start)[0]
    return jnp.where(rejected[tried], before, tried)


def _around(marked, around, v: int) -> Bool[Array, " v"]:
    """Clusters that share a corner with a marked one."""
    touched = [marked.at[a].get(mode="fill", fill_value=False) for a in around]
    touched = touched[0] | touched[1] | touched[2] | touched[3]
    out = jnp.zeros(v, bool)
    for here in around:
        out = out.at[here].max(touched, mode="drop")
    return out


def _have_few_corners(around, new, v: int) -> Bool[Array, " v"]:
    """Clusters with less than three corners where three or more clusters meet."""
    several = sum(n.astype(jnp.int32) for n in new) >= 3
    corners, there = jnp.zeros(v, jnp.int32), jnp.zeros(v, bool)
    for here, first in zip(around, new, strict=True):
        corners = corners.at[here].add((first & several).astype(jnp.int32), mode="drop")
        there = there.at[here].set(True, mode="drop")
    return there & (corners < 3)


def _meet_often(around, new, v: int) -> Bool[Array, " v"]:
    """Clusters that meet another one in several pieces, or in a ring."""
    low, high, single = _pieces(around, new, v)
    out = jnp.zeros(v, bool)
    for which in (low, high):
        out = out.at[jnp.where(single, v, which)].set(True, mode="drop")
    return out


def _pieces(around, new, v: int):
    """Pairs of clusters, sorted, and whether they meet in one piece (at the last of the
    entries of a pair; true elsewhere)."""
    low, high, count = [], [], []
    for n, (i, j) in enumerate(_PAIRS):
        a, b = around[i], around[j]
        apart = (a != b) & (a < v)
        low.append(jnp.where(apart, jnp.minimum(a, b), v))
        high.append(jnp.where(apart, jnp.maximum(a, b), v))
        # Twice the corners, less the sides, each of which has two ends.
        count.append(2 * (new[i] & new[j]).astype(jnp.int32) - (n < 4))
    entries = [jnp.concatenate(x) for x in (low, high, count)]
    low, high, count = lax.sort(entries, num_keys=2)
    last = jnp.append((low[1:] != low[:-1]) | (high[1:] != high[:-1]), True)
    total = jnp.cumsum(count)
    n = total.shape[0]
    at_last = jnp.where(last, jnp.arange(n), -1)
    previous = lax.cummax(jnp.append(-1, at_last[:-1]))
    before = jnp.where(previous >= 0, total[jnp.maximum(previous, 0)], 0)
    return low, high, ~last | (total - before == 2) | (low >= v)
