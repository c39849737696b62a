"""Marching cubes on a dual grid whose nodes lie on the features of the field.

Every cell of the grid, or of an octree over it, gets one node where the graph of the
field has a crease or a corner, if it has one, or else its center (`_graph_fit.py`). The
eight cells around a node of the grid make a dual cell, in which marching cubes cuts the
edges between the nodes of neighboring cells. Edges and corners of the surface are
where the graph has creases, and thin sheets lie between nodes even where the grid has
no node inside them.

The dual grid is closed by nodes on the sides of the grid, beside those of the cells
there, with the interpolated values of the grid: all outside where the nodes of the side
are.

Cells of an octree share their node: cut edges between the same two cells are one
vertex, and faces that lost a corner disappear. Nothing is matched across levels, and so
there are no cracks.

Schaefer and Warren (2004).
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._core import safe_normalize, stage
from ..linear import interpolate
from ..meshes import keep_faces
from ..shapes import Grid, TriangleMesh
from ._ambiguity import SeparateInside
from ._classify import Counts, classify
from ._extraction import Capacity, Extraction
from ._faces import emit_faces
from ._graph_fit import Moments, feature, heights, of_blocks, of_cells
from ._marching_cubes import CLEARANCE, as_float, check_grid, count, finish
from ._placement import Linear
from ._vertices import CutEdges, Samples, find_edges

_SEPARATE = SeparateInside()


class DualGridCubes(eqx.Module):
    """Settings of marching cubes on a feature-aligned dual grid.

    - `tolerance`: the error of the fit of the graph, in units of the field, up to which
      eight cells of the octree become one; 0 for the uniform grid.
    - `levels`: static; octree cells are up to 2^levels grid cells wide.
    - `regularization`: the weight of the center of a cell against its tangent planes.
    """

    tolerance: float = 0.0
    levels: int = eqx.field(static=True, default=0)
    regularization: float = 1e-2

    def __call__(
        self, values, grid, level=0.0, *, capacity, field=None, token=None
    ) -> Extraction:
        """The level set of sampled values; see `dual_grid_cubes`."""
        return dual_grid_cubes(
            values,
            grid,
            level,
            tolerance=self.tolerance,
            levels=self.levels,
            capacity=capacity,
            field=field,
            regularization=self.regularization,
            token=token,
        )

    def measure(self, values, level=0.0, *, token=None) -> Counts:
        """About the sizes that the extraction needs, without making it: those of the
        grid itself."""
        return count(values, level, token=token)


class DualGrid(eqx.Module):
    """The nodes of the dual grid, one per cell of the grid and on its sides: values
    above the level, places and slopes; and the first node that is the same one."""

    values: Float[Array, "x y z"]
    points: Float[Array, "3 x y z"]
    slopes: Float[Array, "3 x y z"]
    owner: Int[Array, "x y z"]


def dual_grid_cubes(
    values: Float[Array, "x y z"],
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    capacity: Capacity,
    tolerance: Float[Array, ""] | float = 0.0,
    levels: int = 0,
    field: Callable | None = None,
    regularization: Float[Array, ""] | float = 1e-2,
    token: Bool[Array, ""] | None = None,
) -> Extraction:
    """The surface where a field equals `level`, with its sharp features, oriented
    toward growing values, by marching cubes on a feature-aligned dual grid.

    Edges of the mesh are shared by exactly two faces, except on the sides of the grid.
    Positions and normals have the derivatives of the formulas with respect to values,
    level, origin, spacing and the parameters of `field`; the faces and the octree have
    none.

    **Arguments:**

    - `values`: [x, y, z] samples at the nodes of `grid`, at least 2 along each axis.
    - `capacity`: static sizes of the mesh on the dual grid before cells are merged; on
      overflow the required sizes are exact.
    - `tolerance`, `levels`, `regularization`: see `DualGridCubes`.
    - `field`: the function of one point [3] that was sampled, for its gradient at the
      nodes and its values at the dual nodes. Without it central differences and the
      fitted values.
    - `token`: a run-time true that keeps stages apart on CPUs (see `stage`), or None.

    **Statuses:** `capacity_exceeded`, `nonfinite_input`, `no_surface`.

    Raises `GeometryError` unless `values` has the shape of the grid, or if the grid is
    too large for 32 bits.
    """
    values, level = as_float(values, level)
    check_grid(values, grid)
    finite = jnp.all(jnp.isfinite(values))
    numbers_of = lambda x: jnp.asarray(x, values.dtype)
    knobs = (level, numbers_of(tolerance), numbers_of(regularization))
    dual = _dual_grid(values, grid, field, *knobs, levels)
    fixed = lax.stop_gradient(dual.values)
    bits, numbers = classify(fixed, jnp.zeros_like(level), _SEPARATE, token)
    shape = dual.values.shape
    edges = find_edges(bits, numbers, shape[2], capacity.vertices, token)
    real = jnp.arange(capacity.vertices) < numbers.needed.vertices
    vertices, normals = stage(token, _place, dual, edges)
    faces = emit_faces(bits, numbers, capacity, token)
    number = jnp.minimum(numbers.needed.vertices, capacity.vertices)
    mesh = TriangleMesh(
        jnp.where(real[:, None], vertices, 0),
        faces.corners,
        jnp.where(real[:, None], normals, 0),
        None,
        number,
        faces.num_faces,
    )
    if levels > 0:
        mesh = _welded(mesh, dual.owner, edges, real)
    return finish(mesh, numbers.needed, finite, capacity)


def _dual_grid(values, grid: Grid, field, level, tolerance, weight, levels) -> DualGrid:
    """The dual nodes of the cells, those of the octree where its cells are merged."""
    scale = jnp.max(grid.spacing)
    size = grid.spacing / scale
    values, slopes = _tangents(values - level, grid, field)
    moments = of_cells(values / scale, slopes, size)
    off, _ = feature(moments, size, weight)
    nodes = _nodes(moments, off, grid, 1, field, level)
    whole = jnp.ones(nodes.owner.shape, bool)
    for depth in range(1, levels + 1):
        width = 2**depth
        if min(n // width for n in nodes.owner.shape) == 0:
            break
        moments = of_blocks(moments, size * (width // 2))
        off, error = feature(moments, size * width, weight)
        # Which cells are merged is a choice: it has no derivative.
        whole = _all_parts(whole) & (lax.stop_gradient(error) * scale <= tolerance)
        merged = _nodes(moments, off, grid, width, field, level)
        nodes = _replaced(nodes, merged, whole, width)
    return _with_sides(nodes, values, grid)


def _replaced(nodes: DualGrid, merged: DualGrid, whole, width) -> DualGrid:
    """The nodes, and those of the merged cells where these are whole."""
    shape = nodes.owner.shape
    there = _spread(whole, width, shape)
    pick = lambda new, old: jnp.where(there, _spread(new, width, shape), old)
    return jax.tree.map(pick, merged, nodes)


def _with_sides(nodes: DualGrid, values, grid: Grid) -> DualGrid:
    """The nodes with a layer of nodes on every side of the grid."""
    for axis in range(3):
        for end in range(2):
            layer = _on_side(nodes, values, grid, axis, end)
            join = lambda x, new, axis=axis, end=end: jnp.concatenate(
                (x, new) if end else (new, x), axis=axis - 3
            )
            nodes = jax.tree.map(join, nodes, layer)
    return nodes


def _on_side(nodes: DualGrid, values, grid: Grid, axis, end) -> DualGrid:
    """The outermost nodes along an axis, moved onto the side of the grid."""
    last = [0, -1][end]
    layer = jax.tree.map(
        lambda x: lax.index_in_dim(x, last, axis=axis - 3 + x.ndim), nodes
    )
    side = grid.origin[axis] + end * (grid.shape[axis] - 1) * grid.spacing[axis]
    points = layer.points.at[axis].set(side)
    index = grid.index_of(points.reshape(3, -1).T)
    heights = interpolate(values, index).reshape(points.shape[1:])
    counts = [n + 1 for n in grid.shape]
    stride = math.prod(counts[axis + 1 :])
    place = layer.owner // stride % counts[axis]
    owner = layer.owner + (end * (counts[axis] - 1) - place) * stride
    return DualGrid(heights, points, layer.slopes, owner)


def _tangents(values, grid, field):
    """Finite values at the nodes of the grid, and their slopes [3, x, y, z]."""
    finite = jnp.isfinite(values)
    values = jnp.where(finite, values, 1)
    if field is None:
        slopes = jnp.gradient(values)
        return values, jnp.stack(slopes) / grid.spacing[:, None, None, None]
    slopes = lax.map(jax.vmap(jax.vmap(jax.grad(field))), grid.nodes())
    sound = finite & jnp.all(jnp.isfinite(slopes), axis=-1)
    return values, jnp.moveaxis(jnp.where(sound[..., None], slopes, 0), -1, 0)


def _nodes(moments: Moments, off, grid: Grid, width, field, level) -> DualGrid:
    """The nodes of cells `width` grid cells wide, `off` their centers."""
    scale = jnp.max(grid.spacing)
    shape = moments.weight.shape
    first = jnp.meshgrid(*(width * jnp.arange(n) for n in shape), indexing="ij")
    points = [
        grid.origin[d] + grid.spacing[d] * (first[d] + width / 2) + scale * off[d]
        for d in range(3)
    ]
    values = scale * heights(moments, off)
    if field is not None:
        at = jax.vmap(jax.vmap(field))
        exact = lax.map(at, jnp.stack(points, axis=-1)) - level
        values = jnp.where(jnp.isfinite(exact), exact, values)
    x, y, z = (f.astype(jnp.int32) + 1 for f in first)
    owner = (x * (grid.shape[1] + 1) + y) * (grid.shape[2] + 1) + z
    return DualGrid(values, jnp.stack(points), moments.slope, owner)


def _all_parts(whole):
    """True for blocks of eight cells that are all True."""
    shape = tuple(n // 2 for n in whole.shape)
    cut = whole[tuple(slice(2 * n) for n in shape)]
    x, y, z = shape
    return jnp.all(cut.reshape(x, 2, y, 2, z, 2), axis=(1, 3, 5))


def _spread(blocks, width, shape):
    """The values of blocks at each of their cells; zero where there is no block."""
    for axis in (-3, -2, -1):
        blocks = jnp.repeat(blocks, width, axis=axis)
    missing = [(0, n - m) for n, m in zip(shape, blocks.shape[-3:], strict=True)]
    return jnp.pad(blocks, [(0, 0)] * (blocks.ndim - 3) + missing)


def _place(dual: DualGrid, edges: CutEdges):
    """The points on cut edges of the dual grid, and the normals there."""
    samples = Samples(dual.values, edges)
    t = Linear()(samples, jnp.zeros((), dual.values.dtype))
    t = jnp.clip(t, CLEARANCE, 1 - CLEARANCE)
    ends = edges.node, edges.node + samples.stride()

    def between(rows):
        low, high = ([r.reshape(-1)[e] for r in rows] for e in ends)
        pairs = zip(low, high, strict=True)
        return jnp.stack([(1 - t) * a + t * b for a, b in pairs], axis=-1)

    return between(dual.points), safe_normalize(between(dual.slopes))


def _welded(mesh: TriangleMesh, owner, edges: CutEdges, real) -> TriangleMesh:
    """The mesh with one vertex for all cut edges between the same two octree cells."""
    v = real.shape[0]
    first = owner.reshape(-1)[edges.node]
    second = owner.reshape(-1)[edges.node + Samples(owner, edges).stride()]
    last = jnp.iinfo(jnp.int32).max
    keys = (jnp.where(real, first, last), jnp.where(real, second, last))
    slots = jnp.arange(v, dtype=jnp.int32)
    low, high, slots = lax.sort((*keys, slots), num_keys=2, is_stable=True)
    new = jnp.append(True, (low[1:] != low[:-1]) | (high[1:] != high[:-1]))
    start = lax.cummax(jnp.where(new, jnp.arange(v), 0))
    name = jnp.zeros(v, jnp.int32).at[slots].set(slots[start])
    faces = name.at[mesh.faces].get(mode="fill", fill_value=v)
    a, b, c = faces.T
    keep = (a != b) & (b != c) & (c != a)
    mesh = eqx.tree_at(lambda m: m.faces, mesh, faces)
    return keep_faces(mesh, keep)
