"""Dual contouring on an octree: large faces where the surface is flat.

The finest grid gives the patches and their tangent planes. Patches are merged in larger
and larger cells of an octree as long as one vertex fits all their planes to a tolerance
and the surface keeps its topology (`_clusters.py`). A cluster gets its vertex as a
patch does, in its octree cell; a quad of the grid becomes a quad, a triangle or
nothing, by the number of clusters around its edge. No cell is contoured by itself:
there are no T-junctions and no cracks.

Ju, Losasso, Schaefer and Warren (2002); Schaefer, Ju and Warren (2007).
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._core import safe_normalize, stage
from ..meshes import keep_faces
from ..shapes import Grid, TriangleMesh
from ._clusters import Clusters, find_clusters, merge_planes, place_clusters
from ._dual import (
    AbstractDualMethod,
    Dual,
    choose_diagonal,
    find_dual,
    splits,
    triangles,
)
from ._dual_contouring import hermite_data, patch_planes
from ._extraction import Capacity, Extraction
from ._hermite import Hermite
from ._marching_cubes import as_float, check_grid, finish
from ._patches import corner_indices
from ._qef import Planes


class AdaptiveDualContouring(AbstractDualMethod):
    """Settings of dual contouring on an octree.

    - `tolerance`: the largest distance of a vertex from the tangent planes of its part
      of the surface, in units of length.
    - `levels`: static; octree cells are up to 2^levels grid cells wide.
    - `regularization`: as of `DualContouring`.
    """

    tolerance: float
    levels: int = eqx.field(static=True, default=5)
    regularization: float = 1e-2

    def __call__(
        self, values, grid, level=0.0, *, capacity, field=None, token=None
    ) -> Extraction:
        """The level set of sampled values; see `adaptive_dual_contouring`."""
        return adaptive_dual_contouring(
            values,
            grid,
            level,
            tolerance=self.tolerance,
            capacity=capacity,
            levels=self.levels,
            field=field,
            regularization=self.regularization,
            token=token,
        )


def adaptive_dual_contouring(
    values: Float[Array, "x y z"],
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    tolerance: Float[Array, ""] | float,
    capacity: Capacity,
    levels: int = 5,
    field: Callable | None = None,
    regularization: Float[Array, ""] | float = 1e-2,
    token: Bool[Array, ""] | None = None,
) -> Extraction:
    """The surface where a sampled field equals `level`, with few faces where it is
    flat, oriented toward growing values.

    The mesh of `dual_contouring`, simplified: as many components, boundaries and
    handles, edges shared by exactly two faces except at the sides of the grid, where
    nothing is merged. Positions and normals have derivatives as there, for the merged
    patches as they are.

    **Arguments:**

    - `tolerance`: the largest distance of a vertex from the tangent planes at the
      crossings of the patches that it stands for, in units of length.
    - `levels`: static; octree cells are up to 2^levels grid cells wide.
    - `capacity`: static sizes of the mesh before it is simplified.
    - the others: as of `dual_contouring`.

    **Statuses:** `capacity_exceeded`, `nonfinite_input`, `no_surface`. The required
    sizes are those before the mesh is simplified.

    Raises `GeometryError` unless `values` has the shape of the grid, or if the grid is
    too large for 32 bits.
    """
    values, level = as_float(values, level)
    check_grid(values, grid)
    dual = find_dual(values, level, capacity, token)
    hermite = hermite_data(field, values, dual, grid, level, token)
    weight = jnp.asarray(regularization, values.dtype)
    size = grid.spacing / jnp.max(grid.spacing)
    planes = stage(token, lambda h, p: patch_planes(h, p, size), hermite, dual.patches)
    # Which patches are merged is a choice: it has no derivative.
    fixed = lax.stop_gradient((dual, hermite, planes, grid, weight))
    off = lax.stop_gradient(tolerance / jnp.max(grid.spacing)).astype(values.dtype)
    clusters = find_clusters(*fixed, off, levels)
    mesh = _merged_mesh(dual, hermite, planes, clusters, grid, weight, capacity)
    return finish(mesh, dual.needed, dual.bits.finite, capacity)


def _merged_mesh(
    dual: Dual, hermite: Hermite, planes: Planes, clusters: Clusters, grid, weight, size
) -> TriangleMesh:
    """The mesh with a vertex per cluster."""
    merged = merge_planes(planes, clusters, dual.patches, grid)
    local = place_clusters(merged, clusters, dual.patches, grid, weight)
    corner = corner_indices(dual.patches.node, grid.shape)
    vertices = grid.origin + grid.spacing * corner + jnp.max(grid.spacing) * local.T
    real = dual.patches.complete[:, None]
    vertices = jnp.where(real, vertices, 0.0)
    normals = jnp.where(real, safe_normalize(merged.direction.T), 0.0)
    label = jnp.append(clusters.label, vertices.shape[0])
    quads = jnp.where(dual.held, label.at[dual.quads].get(mode="clip"), dual.quads)
    dual = eqx.tree_at(lambda d: d.quads, dual, quads)
    at = lax.stop_gradient((vertices, hermite.t))
    turned = choose_diagonal(splits(dual, *at, grid))
    faces, num_faces = triangles(dual, turned, size)
    a, b, c = faces.T
    keep = (a != b) & (b != c) & (c != a)
    number = jnp.minimum(dual.needed.vertices, size.vertices)
    mesh = TriangleMesh(vertices, faces, normals, None, number, num_faces)
    return keep_faces(mesh, keep)
