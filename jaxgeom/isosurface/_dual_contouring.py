"""Dual contouring: a vertex per surface patch where its tangent planes meet.

Classify and compact as marching cubes does. Hermite data: every cut edge gets its
crossing and its normal (`_hermite.py`). Place: a patch gets the point of its cell that
fits the tangent planes of its crossings best (`_qef.py`), on a flat patch their mean,
on an edge or a corner of the body the edge or the corner; where the field is there to
ask, also edges and corners that only the cells around see (`_features.py`). Emit: a
quad per cut edge, split where the surface is (`_dual.py`).

Ju, Losasso, Schaefer and Warren (2002); one vertex per patch and the flipped faces:
Nielson (2004), Schaefer, Ju and Warren (2007).
"""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import safe_normalize, stage
from ..shapes import Grid
from ._dual import AbstractDualMethod, Dual, dual_mesh, find_dual
from ._extraction import Capacity, Extraction
from ._features import take_features
from ._hermite import CLEARANCE, Hermite, from_field, from_samples
from ._marching_cubes import as_float, check_grid
from ._patches import Patches, corner_indices
from ._qef import Planes, fit_planes, minimize

# Tikhonov's steps of `_qef.py`.
STEPS = 4


class DualContouring(AbstractDualMethod):
    """Settings of dual contouring.

    - `regularization`: the weight of the mean crossing against the tangent planes, in
      units of the mean squared cosine between their normals (see `dual_contouring`).
    """

    regularization: float = 1e-2

    def __call__(
        self, values, grid, level=0.0, *, capacity, field=None, token=None
    ) -> Extraction:
        """The level set of sampled values; see `dual_contouring`."""
        return dual_contouring(
            values,
            grid,
            level,
            capacity=capacity,
            field=field,
            regularization=self.regularization,
            token=token,
        )


def dual_contouring(
    values: Float[Array, "x y z"],
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    capacity: Capacity,
    field: Callable | None = None,
    regularization: Float[Array, ""] | float = 1e-2,
    token: Bool[Array, ""] | None = None,
) -> Extraction:
    """The surface where a field equals `level`, with its edges and corners, as a mesh
    that shares vertices, oriented toward growing values.

    A vertex per surface patch of a cell, in the cell: the point x that minimises
    sum_i (n_i . (x - p_i))^2 over the crossings p_i and normals n_i of the patch, held
    to their mean where the planes do not determine it. With `field`, a patch that does
    not see an edge or a corner beside it uses the planes of the patches around, and its
    vertex may then lie beyond one side of its cell, in a cell without surface. Edges of
    the mesh are shared by exactly two faces, except along the sides of the grid, where
    the outer half cell has no faces. Inside is values < level, strictly.

    Positions and normals have the derivatives of these formulas with respect to values,
    level, origin, spacing and the parameters of `field`; the faces have none.

    **Arguments:**

    - `values`: [x, y, z] samples at the nodes of `grid`, at least 2 along each axis.
    - `capacity`: static sizes; `DualContouring().measure` gives them, `extract` does
      all of it. There are two faces per cut edge of the grid.
    - `field`: the function of one point [3] that was sampled: crossings are its roots
      and normals its gradient, which is what finds sharp edges. Without it lines
      through the samples and central differences, which round them off.
    - `regularization`: w of `_qef.py`, relative to unit normals. Larger keeps
      vertices nearer to the mean crossing, on surfaces with noise.
    - `token`: a run-time true that keeps stages apart on CPUs (see `stage`), or None.

    **Statuses:** `capacity_exceeded`, `nonfinite_input`, `no_surface`.

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
    local = stage(token, in_cell, planes, size, weight)
    if field is not None:
        local = take_features(local, planes, weight, field, values, dual, grid, level)
    corner = grid.origin + grid.spacing * corner_indices(dual.patches.node, grid.shape)
    vertices = corner + jnp.max(grid.spacing) * local.T
    normals = safe_normalize(planes.direction.T)
    return dual_mesh(dual, vertices, normals, hermite.t, grid, capacity, token)


def hermite_data(field, values, dual: Dual, grid, level, token) -> Hermite:
    """Crossings and normals of all cut edges, from the field where there is one."""
    if field is None:
        return from_samples(values, dual.edges, grid, level, token)
    return from_field(field, values, dual.edges, dual.inside, grid, level)


def in_cell(planes: Planes, size, weight) -> Float[Array, "3 v"]:
    """The vertex of every patch from the corner of its cell, which is of this size."""
    return minimize(planes, CLEARANCE * size, (1 - CLEARANCE) * size, weight, STEPS)


def patch_planes(hermite: Hermite, patches: Patches, size) -> Planes:
    """The planes of every patch, from the corner of its cell, which is of this size."""
    normals = hermite.normals.T

    def read(slot):
        edge, code, held = slot
        along, axis = hermite.t[edge], code & 3
        corner = [(code >> (2 + d) & 1).astype(along.dtype) for d in range(3)]
        place = [jnp.where(axis == d, along, corner[d]) * size[d] for d in range(3)]
        return place, [n[edge] for n in normals], held.astype(along.dtype)

    slots = (patches.edge, patches.code, patches.held)
    return fit_planes(read, slots, jnp.zeros(patches.node.shape, hermite.t.dtype))
