"""FlexiCubes: dual marching cubes with weights, made to be moved by gradients.

With raw weights a, b, g, d of any size, all zero at first:

    alpha = 1 + 0.99 tanh a     per corner of a cell, scales the value there
    beta  = 1 + 0.99 tanh b     per edge of a cell, weighs the crossing on it
    gamma = 0.005 + 0.99 sigmoid g     per cell, decides how quads are split
    x'    = x + (h / 2) tanh d  per node, moves it within half a spacing

The crossing of the edge (i, j) as its cell sees it is the root of the line through the
scaled values, u = x_i + t (x_j - x_i), t = alpha_i s_i / (alpha_i s_i - alpha_j s_j),
with s the values above the level. The vertex of a patch is sum beta u / sum beta, in
the convex hull of its crossings. The weights of a cell reach only its own vertices, so
that each vertex can be put anywhere in that hull.

L_dev, the regulariser: for each vertex v, with d_e = |v - u_e| over its crossings
without weights, mean_e |d_e - mean d|; it keeps vertices amid their crossings.

Shen et al. (2023), equations 4 to 8.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import check_shape, prefix_sum, safe_divide, safe_norm
from ..shapes import Grid, TriangleMesh
from ._classify import Counts
from ._dual import Dual, count_dual, find_dual, triangles
from ._extraction import Capacity, Extraction
from ._hermite import CLEARANCE
from ._marching_cubes import as_float, check_grid, finish
from ._vertices import coordinates

_REACH = 0.99
_LEAST = 0.005


class FlexiWeights(eqx.Module):
    """The raw weights of FlexiCubes on a grid of x, y, z nodes; any real numbers.

    - `corners`: [x-1, y-1, z-1, 8] a, corner x + 2y + 4z of each cell.
    - `edges`: [x-1, y-1, z-1, 12] b, edge 4 axis + u + 2v: u and v the offsets of the
      edge along the two axes after its own.
    - `splits`: [x-1, y-1, z-1] g.
    - `offsets`: [x, y, z, 3] d.
    """

    corners: Float[Array, "x-1 y-1 z-1 8"]
    edges: Float[Array, "x-1 y-1 z-1 12"]
    splits: Float[Array, "x-1 y-1 z-1"]
    offsets: Float[Array, "x y z 3"]

    @staticmethod
    def zeros(shape: tuple[int, int, int], dtype=float) -> "FlexiWeights":
        """The weights that make `flexicubes` dual marching cubes."""
        cells = tuple(n - 1 for n in shape)
        zeros = lambda *s: jnp.zeros(s, dtype)
        return FlexiWeights(
            zeros(*cells, 8), zeros(*cells, 12), zeros(*cells), zeros(*shape, 3)
        )


class FlexiExtraction(eqx.Module):
    """An extraction, and the regulariser L_dev of each vertex of the dual, 0 in
    padding: its mean belongs in the loss."""

    extraction: Extraction
    deviation: Float[Array, " v"]


class AbstractQuadSplit(eqx.Module):
    """How quads become triangles."""

    faces_per_quad: eqx.AbstractClassVar[int]

    @abstractmethod
    def split(self, dual: Dual, vertices, gamma, capacity: Capacity):
        """Vertices, faces and their numbers; `gamma` [4, e] around each quad."""


class Diagonals(AbstractQuadSplit):
    """Two triangles, cut along the diagonal with the larger product of gamma: for the
    final mesh. The choice has no derivative."""

    faces_per_quad = 2

    def split(self, dual, vertices, gamma, capacity):
        """Vertices, faces and their numbers."""
        turned = gamma[0] * gamma[2] <= gamma[1] * gamma[3]
        faces, num_faces = triangles(dual, turned, capacity)
        number = jnp.minimum(dual.needed.vertices, vertices.shape[0])
        return vertices, faces, number, num_faces


class Centers(AbstractQuadSplit):
    """Four triangles about a center that moves between the middles of the diagonals
    with the products of gamma: for fitting, where it carries their derivatives."""

    faces_per_quad = 4

    def split(self, dual, vertices, gamma, capacity):
        """Vertices, faces and their numbers; the centers follow the dual vertices."""
        size = vertices.shape[0]
        corner = [vertices.at[q].get(mode="clip") for q in dual.quads]
        first, second = gamma[0] * gamma[2], gamma[1] * gamma[3]
        share = (first / (first + second))[:, None]
        middle = share * (corner[0] + corner[2]) + (1 - share) * (corner[1] + corner[3])
        number = jnp.minimum(dual.needed.vertices, size)
        place = prefix_sum(dual.held.astype(jnp.int32))
        center = (number + place).astype(jnp.int32)
        fits = dual.held & (center < size)
        slot = jnp.where(fits, center, size)
        vertices = vertices.at[slot].set(middle / 2, mode="drop")
        faces = jnp.full((capacity.faces, 3), size, jnp.int32)
        for i in range(4):
            ends = (dual.quads[i], dual.quads[(i + 1) % 4], center)
            where = jnp.where(fits, 4 * place + i, capacity.faces)
            faces = faces.at[where].set(jnp.stack(ends, axis=-1), mode="drop")
        num = jnp.sum(fits)
        return vertices, faces, number + num, 4 * num


_DIAGONALS = Diagonals()


class FlexiCubes(eqx.Module):
    """Settings of FlexiCubes.

    - `weights`: `FlexiWeights` of the grid; without, all zero.
    - `split`: `Diagonals()` for the final mesh, `Centers()` for fitting.
    """

    weights: FlexiWeights | None = None
    split: AbstractQuadSplit = _DIAGONALS

    def __call__(
        self, values, grid, level=0.0, *, capacity, field=None, token=None
    ) -> Extraction:
        """The level set of sampled values; see `flexicubes`. The field behind them is
        not used."""
        weights = self.weights
        if weights is None:
            weights = FlexiWeights.zeros(grid.shape, as_float(values, level)[0].dtype)
        out = flexicubes(
            values,
            grid,
            weights,
            level,
            capacity=capacity,
            split=self.split,
            token=token,
        )
        return out.extraction

    def measure(self, values, level=0.0, *, token=None) -> Counts:
        """The sizes that the extraction needs, without making it."""
        return _scaled(count_dual(*as_float(values, level), token), self.split)


def flexicubes(
    values: Float[Array, "x y z"],
    grid: Grid,
    weights: FlexiWeights,
    level: Float[Array, ""] | float = 0.0,
    *,
    capacity: Capacity,
    split: AbstractQuadSplit = _DIAGONALS,
    token: Bool[Array, ""] | None = None,
) -> FlexiExtraction:
    """The surface where a sampled field equals `level`, shaped by weights, and the
    regulariser of the weights.

    The mesh has the topology of `dual_marching_cubes`, edges shared by exactly two
    faces; faces may overlap where weights are extreme. Positions and the regulariser
    have derivatives with respect to values, weights, level, origin and spacing; the
    faces have none, and `gamma` has one with `Centers()` only.

    **Arguments:**

    - `values`: [x, y, z] samples at the nodes of `grid`, at least 2 along each axis.
    - `weights`: of the same grid; `FlexiWeights.zeros(grid.shape)` to begin with.
    - `capacity`: static sizes; `FlexiCubes(split=split).measure` gives them.
    - `split`: `Diagonals()` for the final mesh, `Centers()` for fitting.
    - `token`: a run-time true that keeps stages apart on CPUs (see `stage`), or None.

    **Statuses:** `capacity_exceeded`, `nonfinite_input`, `no_surface`.

    Raises `GeometryError` unless values and weights have the shape of the grid, or if
    the grid is too large for 32 bits.
    """
    values, level = as_float(values, level)
    check_grid(values, grid)
    cells = tuple(n - 1 for n in grid.shape)
    check_shape("weights.corners", weights.corners, (*cells, 8))
    check_shape("weights.edges", weights.edges, (*cells, 12))
    check_shape("weights.splits", weights.splits, cells)
    check_shape("weights.offsets", weights.offsets, (*grid.shape, 3))
    quads = max(capacity.faces // split.faces_per_quad, 1)
    inner = Capacity(capacity.vertices, 2 * quads, capacity.cells)
    dual = find_dual(values, level, inner, token)
    vertices, deviation = _place(values, level, dual, grid, weights)
    gamma = _LEAST + _REACH * jax.nn.sigmoid(weights.splits.reshape(-1))
    gamma = gamma[_cell_index(dual.patches.node, grid.shape)]
    around = jnp.stack([gamma.at[q].get(mode="clip") for q in dual.quads])
    split_up = split.split(dual, vertices, around, capacity)
    vertices, faces, num_vertices, num_faces = split_up
    mesh = TriangleMesh(vertices, faces, None, None, num_vertices, num_faces)
    needed = _scaled(dual.needed, split)
    return FlexiExtraction(finish(mesh, needed, dual.bits.finite, capacity), deviation)


def _scaled(needed: Counts, split) -> Counts:
    """The sizes with the faces and centers of a way to split quads."""
    quads = needed.faces // 2
    centers = quads if split.faces_per_quad == 4 else 0
    faces = split.faces_per_quad * quads
    return Counts(needed.vertices + centers, faces, needed.cells)


def _place(values, level, dual: Dual, grid: Grid, weights: FlexiWeights):
    """The vertex of every patch, and how unevenly its crossings lie around it."""
    patches = dual.patches
    code, (_, ny, nz) = patches.code, grid.shape
    axis, corner = code & 3, code >> 2 & 7
    strides = jnp.array((ny * nz, nz, 1), jnp.int32)
    low = patches.node + sum((corner >> d & 1) * strides[d] for d in range(3))
    ends = (low, low + strides[axis])
    above = values.reshape(-1) - level
    s0, s1 = (above.at[end].get(mode="clip") for end in ends)
    sound = jnp.isfinite(s0) & jnp.isfinite(s1)
    s0, s1 = jnp.where(sound, s0, 1.0), jnp.where(sound, s1, -1.0)
    x0, x1 = (moved_nodes(end, grid, weights.offsets) for end in ends)
    cell = _cell_index(patches.node, grid.shape)
    alpha = 1 + _REACH * jnp.tanh(weights.corners.reshape(-1))
    a0 = alpha[8 * cell + corner]
    a1 = alpha[8 * cell + (corner | 1 << axis)]
    u, v = corner >> (axis + 1) % 3 & 1, corner >> (axis + 2) % 3 & 1
    beta = 1 + _REACH * jnp.tanh(weights.edges.reshape(-1))
    beta = jnp.where(patches.held, beta[12 * cell + 4 * axis + u + 2 * v], 0.0)
    seen = _between(a0 * s0, a1 * s1, x0, x1)
    total = jnp.sum(beta, axis=0)
    vertices = safe_divide(jnp.sum(beta[..., None] * seen, axis=0), total[:, None])
    real = patches.complete
    vertices = jnp.where(real[:, None], vertices, 0.0)
    reach = safe_norm(vertices - _between(s0, s1, x0, x1))
    return vertices, jnp.where(real, _unevenness(reach, patches.held), 0.0)


def _between(s0, s1, x0, x1):
    """The root of the line through two values of opposite sign, kept off the ends."""
    t = safe_divide(s0, s0 - s1)
    return x0 + jnp.clip(t, CLEARANCE, 1 - CLEARANCE)[..., None] * (x1 - x0)


def _unevenness(reach, held):
    """The mean absolute deviation of the distances of every patch."""
    number = jnp.maximum(jnp.sum(held, axis=0), 1)
    mean = jnp.sum(jnp.where(held, reach, 0.0), axis=0) / number
    return jnp.sum(jnp.where(held, jnp.abs(reach - mean), 0.0), axis=0) / number


def moved_nodes(node, grid, offsets):
    """The places [..., 3] of nodes by their flat indices, with their offsets."""
    place = jnp.stack(coordinates(node, grid.shape), axis=-1)
    shift = jnp.tanh(offsets.reshape(-1, 3).at[node].get(mode="clip")) / 2
    return grid.origin + grid.spacing * (place + shift)


def _cell_index(node, shape):
    """The flat index of the cell whose lower corner is a node."""
    x, y, z = coordinates(node, shape)
    _, ny, nz = shape
    return (x * (ny - 1) + y) * (nz - 1) + z
