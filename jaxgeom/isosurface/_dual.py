"""The dual of the cut edges: a vertex per surface patch, a quad per cut edge.

A cut edge inside the grid has four cells around it, and in each one patch that holds
it: their vertices are the corners of its quad. A side of a quad joins the patches of
two cells across a face, once for each end of the segment in that face: every side has
two quads, on opposite sides (`_patch_tables.py` deals with faces that have two segments
between the same patches). Two cells across an edge share no other edge: no diagonal of
a quad is an edge of another.

Seen along the cut edge, the four vertices lie in the four quadrants around it, in
order, and the quad has at most one corner bent inward. The diagonal is chosen so that
both triangles face along the edge, and thus have an area; if both diagonals do, so that
the surface passes the edge where the field does, which keeps creases and ridges; if
both do that as well, by the better shape.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._core import prefix_sum, safe_divide, stage
from ..shapes import Grid, TriangleMesh
from ._ambiguity import SeparateInside
from ._bits import WORD, below, popcount
from ._classify import Bits, Counts, Numbers, classify
from ._extraction import Capacity, Extraction
from ._marching_cubes import as_float, finish
from ._patch_tables import patch_tables
from ._patches import (
    PatchCells,
    Patches,
    count_patches,
    find_cells,
    find_patches,
    num_edges,
)
from ._vertices import CutEdges, coordinates, find_edges

_BIT = WORD.bit_length() - 1
_SEPARATE = SeparateInside()
# A triangle narrower than this, seen along the edge and relative to its quad, is bad.
_NARROW = 0.02
# Distances along an edge, in cells, below which two diagonals fit it equally well.
_SAME_FIT = 1e-3
# Differences of the smaller triangle, relative to the quad, that do not count.
_SAME_SHAPE = 1e-3


class AbstractDualMethod(eqx.Module):
    """Settings of an extractor with a vertex per patch and two faces per cut edge."""

    @abstractmethod
    def __call__(
        self, values, grid, level=0.0, *, capacity, field=None, token=None
    ) -> Extraction:
        """The level set of sampled values, and of the `field` behind them if given."""

    def measure(self, values, level=0.0, *, token=None) -> Counts:
        """The sizes that the extraction needs, without making it."""
        return count_dual(*as_float(values, level), token)


class Dual(eqx.Module):
    """The topology of the dual mesh; all of it without derivatives."""

    bits: Bits
    needed: Counts
    edges: CutEdges
    num_cut: Int[Array, ""]
    inside: Bool[Array, " e"]
    patches: Patches
    quads: Int[Array, "4 e"]
    held: Bool[Array, " e"]


def count_dual(values, level, token) -> Counts:
    """The sizes that a dual extraction needs; an upper bound but for the cells."""
    bits, numbers = classify(values, level, _SEPARATE, token)
    return stage(token, count_patches, bits, numbers)


def find_dual(values, level, capacity: Capacity, token) -> Dual:
    """The patches and quads of the level set of sampled values."""
    values, level = lax.stop_gradient((values, level))
    bits, numbers = classify(values, level, _SEPARATE, token)
    bound = stage(token, count_patches, bits, numbers)
    shape = values.shape
    edges = find_edges(bits, numbers, shape[2], num_edges(capacity), token)
    cells = find_cells(bits, numbers, shape, capacity, token)
    patches = find_patches(cells, bits, numbers, shape, capacity, token)
    lower = values.reshape(-1)[edges.node]
    inside = (lower < level) & jnp.isfinite(lower)
    found = (edges, inside, cells, patches.complete, bits.cells, numbers)
    quads, held = stage(token, lambda *a: _quads(*a, shape), *found)
    exact = numbers.needed.cells <= capacity.cells
    vertices = jnp.where(exact, cells.num_vertices, bound.vertices)
    needed = Counts(vertices, bound.faces, bound.cells)
    cut = numbers.needed.vertices
    return Dual(bits, needed, edges, cut, inside, patches, quads, held)


def _quads(edges, inside, cells: PatchCells, complete, active, numbers: Numbers, shape):
    """The four vertices around every cut edge, counter-clockwise seen from outside."""
    place = coordinates(edges.node, shape)
    corners, valid = [], jnp.arange(edges.node.shape[0]) < numbers.needed.vertices
    for d in range(3):
        within = (place[d] > 0) & (place[d] < shape[d] - 1)
        valid = valid & (within | (edges.axis == d))
    node = jnp.where(valid, edges.node, 0)
    for du, dv in ((1, 1), (0, 1), (0, 0), (1, 0)):
        vertex, listed = _vertex_of(
            node, edges.axis, du, dv, cells, active, numbers, shape
        )
        fits = vertex < complete.shape[0]
        whole = complete.at[vertex].get(mode="fill", fill_value=False)
        valid = valid & listed & fits & whole
        corners.append(vertex)
    a, b, c, d = corners
    # The order is counter-clockwise seen from the upper end of the edge.
    return jnp.stack([a, jnp.where(inside, b, d), c, jnp.where(inside, d, b)]), valid


def _vertex_of(node, axis, du, dv, cells, active, numbers, shape):
    """The vertex that holds an edge in the cell du, dv steps back beside its axis, and
    whether that cell is listed."""
    _, ny, nz = shape
    strides = jnp.array((ny * nz, nz, 1), jnp.int32)
    back = du * strides[(axis + 1) % 3] + dv * strides[(axis + 2) % 3]
    corner = jnp.maximum(node - back, 0)
    line, column = corner // nz, corner % nz
    word, bit = line * active.shape[2] + (column >> _BIT), column & (WORD - 1)
    bits = active.reshape(-1).at[word].get(mode="clip") & below(bit)
    number = numbers.first_cell.at[word].get(mode="clip") + popcount(bits)
    listed = number < cells.row.shape[0]
    row = cells.row.at[number].get(mode="clip")
    patch = jnp.asarray(patch_tables().patches)[row] >> 2 * (4 * axis + du + 2 * dv) & 3
    return cells.first.at[number].get(mode="clip") + patch, listed


class QuadSplit(eqx.Module):
    """Where the diagonals of a quad would pass its edge, and how they would look.

    - `narrow`: [2, e] the smaller of the two triangles of each diagonal, seen along the
      edge, relative to the quad; negative where one faces backward.
    - `misfit`: [2, e] the distance of the surface from the crossing, in cells.
    """

    narrow: Float[Array, "2 e"]
    misfit: Float[Array, "2 e"]


def splits(dual: Dual, vertices, t, grid: Grid) -> QuadSplit:
    """Both ways to split every quad."""
    across_u, across_v, along = _around_edge(dual, vertices, grid)
    cross = lambda i, j: across_u[i] * across_v[j] - across_u[j] * across_v[i]
    area = lambda i, j, k: cross(i, j) + cross(j, k) + cross(k, i)
    total = cross(0, 1) + cross(1, 2) + cross(2, 3) + cross(3, 0)
    narrow, misfit = [], []
    for i, j, k, m in ((0, 1, 2, 3), (1, 2, 3, 0)):
        smaller = jnp.minimum(area(i, j, k), area(i, k, m))
        narrow.append(safe_divide(smaller, total))
        # The edge passes the triangle on whose side of the diagonal it lies.
        first = cross(k, i) >= 0
        height = lambda p, q, r: safe_divide(
            cross(q, r) * along[p] + cross(r, p) * along[q] + cross(p, q) * along[r],
            area(p, q, r),
        )
        at_edge = jnp.where(first, height(i, j, k), height(i, k, m))
        misfit.append(jnp.abs(at_edge - t))
    return QuadSplit(jnp.stack(narrow), jnp.stack(misfit))


def _around_edge(dual, vertices, grid):
    """The quad corners beside and along the edge, in cells from its lower node; a turn
    about the edge is positive where the quad is seen from outside."""
    node = coordinates(dual.edges.node, grid.shape)
    base = grid.origin + grid.spacing * jnp.stack(node, axis=-1)
    out = []
    for i in range(4):
        points = vertices.at[dual.quads[i]].get(mode="clip")
        out.append((points - base) / grid.spacing)
    local = jnp.stack(out)
    pick = lambda d: jnp.take_along_axis(
        local, ((dual.edges.axis + d) % 3)[None, :, None], axis=2
    )[..., 0]
    sign = jnp.where(dual.inside, 1.0, -1.0).astype(local.dtype)
    return pick(1), sign * pick(2), pick(0)


def choose_diagonal(split: QuadSplit) -> Bool[Array, " e"]:
    """True for the diagonal from corner 1 to corner 3."""
    bad = split.narrow < _NARROW
    # Rectangles are frequent: rounding must not choose for them.
    shape = split.narrow[1] > split.narrow[0] + _SAME_SHAPE
    fit = split.misfit[1] < split.misfit[0]
    same = jnp.abs(split.misfit[1] - split.misfit[0]) < _SAME_FIT
    return jnp.where(
        bad[0] & bad[1],
        shape,
        jnp.where(bad[0] | bad[1], bad[0], jnp.where(same, shape, fit)),
    )


def triangles(dual: Dual, turned, capacity: Capacity):
    """Two faces per quad, packed, and their number; `turned` cuts from 1 to 3."""
    a, b, c, d = dual.quads
    first = jnp.stack([a, b, jnp.where(turned, d, c)], axis=-1)
    second = jnp.stack([jnp.where(turned, b, a), c, d], axis=-1)
    place = jnp.where(
        dual.held, prefix_sum(dual.held.astype(jnp.int32)), capacity.faces
    )
    faces = jnp.full((capacity.faces, 3), capacity.vertices, jnp.int32)
    for i, corners in enumerate((first, second)):
        slot = jnp.where(dual.held, 2 * place + i, capacity.faces)
        faces = faces.at[slot].set(corners, mode="drop")
    return faces, 2 * jnp.sum(dual.held)


def dual_mesh(dual: Dual, vertices, normals, t, grid, capacity, token) -> Extraction:
    """The mesh of placed vertices, every quad split in two."""
    real = dual.patches.complete[:, None]
    vertices = jnp.where(real, vertices, 0.0)
    normals = None if normals is None else jnp.where(real, normals, 0.0)
    # Which diagonal is shorter is a choice: it has no derivative.
    at = lax.stop_gradient((vertices, t))
    turned = stage(
        token, lambda d, v, t: choose_diagonal(splits(d, v, t, grid)), dual, *at
    )
    faces, num_faces = stage(
        token, lambda d, s: triangles(d, s, capacity), dual, turned
    )
    num_vertices = jnp.minimum(dual.needed.vertices, capacity.vertices)
    mesh = TriangleMesh(vertices, faces, normals, None, num_vertices, num_faces)
    return finish(mesh, dual.needed, dual.bits.finite, capacity)
