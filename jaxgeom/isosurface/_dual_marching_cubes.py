"""Dual marching cubes: a vertex per surface patch, at the mean of its crossings.

The mesh is the dual of that of marching cubes, a quad per cut edge of the grid: fewer
slivers and more even faces, on smooth surfaces, where sharp edges do not matter.

The crossings are off the surface by O(h^2), and so is their mean.

Nielson (2004); the faces that are flipped to keep it manifold: `_patch_tables.py`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import safe_normalize, stage
from ..shapes import Grid
from ._dual import AbstractDualMethod, Dual, dual_mesh, find_dual
from ._dual_contouring import patch_planes
from ._extraction import Capacity, Extraction
from ._hermite import CLEARANCE, Hermite
from ._marching_cubes import as_float, check_grid
from ._patches import corner_indices
from ._placement import AbstractPlacement, Linear
from ._vertices import Samples, directions

_LINEAR = Linear()


class DualMarchingCubes(AbstractDualMethod):
    """Settings of dual marching cubes in Nielson's sense.

    - `placement`: where crossings lie on their edges, `Linear()` or `Cubic()`.
    """

    placement: AbstractPlacement = _LINEAR

    def __call__(
        self, values, grid, level=0.0, *, capacity, field=None, token=None
    ) -> Extraction:
        """The level set of sampled values; see `dual_marching_cubes`. The field behind
        them is not used."""
        return dual_marching_cubes(
            values,
            grid,
            level,
            capacity=capacity,
            placement=self.placement,
            token=token,
        )


def dual_marching_cubes(
    values: Float[Array, "x y z"],
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    capacity: Capacity,
    placement: AbstractPlacement = _LINEAR,
    token: Bool[Array, ""] | None = None,
) -> Extraction:
    """The surface where a sampled field equals `level`, as the mesh dual to that of
    `marching_cubes`, oriented toward growing values.

    A vertex per surface patch of a cell: the mean of the points where the patch crosses
    the edges of the cell. Edges of the mesh are shared by exactly two faces, except
    along the sides of the grid, where the outer half cell has no faces. Inside is
    values < level, strictly.

    Positions and normals have the derivatives of these formulas with respect to values,
    level, origin and spacing; the faces have none.

    **Arguments:**

    - `values`: [x, y, z] samples at the nodes of `grid`, at least 2 along each axis.
    - `capacity`: static sizes; `DualMarchingCubes().measure` gives them, `extract` does
      all of it. There are two faces per cut edge of the grid.
    - `placement`: `Linear()`, or `Cubic()` for smooth fields.
    - `token`: a run-time true that keeps stages apart on CPUs (see `stage`), or None.

    **Statuses:** `capacity_exceeded`, `nonfinite_input`, `no_surface`.

    Raises `GeometryError` unless `values` has the shape of the grid, or if the grid is
    too large for 32 bits.
    """
    values, level = as_float(values, level)
    check_grid(values, grid)
    dual = find_dual(values, level, capacity, token)
    samples = Samples(values, dual.edges)
    held = lambda s, v: jnp.clip(placement(s, v), CLEARANCE, 1 - CLEARANCE)
    t = stage(token, held, samples, level)
    normals = directions(t, samples, grid, token)
    hermite = Hermite(t, normals)
    vertices, normals = stage(token, lambda h, d: _means(h, d, grid), hermite, dual)
    return dual_mesh(dual, vertices, normals, t, grid, capacity, token)


def _means(hermite: Hermite, dual: Dual, grid: Grid):
    """The mean crossing and the mean normal of every patch."""
    planes = patch_planes(hermite, dual.patches, jnp.ones(3, hermite.t.dtype))
    corner = corner_indices(dual.patches.node, grid.shape) + planes.mean.T
    normals = safe_normalize(planes.direction.T)
    return grid.origin + grid.spacing * corner, normals
