"""Dual contouring: a vertex per surface patch where its tangent planes meet.

Classify and compact as marching cubes does. Hermite data: every cut edge gets its
crossing and its normal (`_hermite.py`). Place: a patch gets the point of its cell that
fits the tangent planes of its crossings best (`_qef.py`), on a flat patch their mean,
on an edge or a corner of the body the edge or the corner. A corner whose edges of the
cell miss one of its planes is found by cutting planes (Kelley 1960): where the field is
not zero at the vertex, its tangent plane there is the one that was missed. Emit: a quad
per cut edge, split where the surface is (`_dual.py`).

Ju, Losasso, Schaefer and Warren (2002); one vertex per patch and the flipped faces:
Nielson (2004), Schaefer, Ju and Warren (2007).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._core import safe_divide, safe_norm, safe_normalize, stage
from ..shapes import Grid
from ._classify import Counts
from ._dual import Dual, count_dual, dual_mesh, find_dual
from ._extraction import Capacity, Extraction
from ._hermite import CLEARANCE, Hermite, from_field, from_samples
from ._marching_cubes import as_float, check_grid
from ._patches import Patches, corner_indices
from ._qef import Planes, minimize_all

_STEPS = 4
_PROJECTIONS = 2


class DualContouring(eqx.Module):
    """Settings of dual contouring.

    - `regularization`: the weight of the mean crossing against the tangent planes, in
      units of the mean squared cosine between their normals (see `dual_contouring`).
    - `cuts`: static; tangent planes of the field added at the vertex, one by one.
    """

    regularization: float = 1e-2
    cuts: int = eqx.field(static=True, default=3)

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
            cuts=self.cuts,
            token=token,
        )

    def measure(self, values, level=0.0, *, token=None) -> Counts:
        """The sizes that the extraction needs, without making it."""
        return count_dual(*as_float(values, level), token)


def dual_contouring(
    values: Float[Array, "x y z"],
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    capacity: Capacity,
    field: Callable | None = None,
    regularization: Float[Array, ""] | float = 1e-2,
    cuts: int = 3,
    token: Bool[Array, ""] | None = None,
) -> Extraction:
    """The surface where a field equals `level`, with its edges and corners, as a mesh
    that shares vertices, oriented toward growing values.

    A vertex per surface patch of a cell, in the cell: the point x that minimises
    sum_i (n_i . (x - p_i))^2 over the crossings p_i and normals n_i of the patch, held
    to their mean where the planes do not determine it. Edges of the mesh are shared by
    exactly two faces, except along the sides of the grid, where the outer half cell has
    no faces. Inside is values < level, strictly.

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
    - `cuts`: static; how often the tangent plane of `field` at the vertex itself is
      added to those of the crossings.
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
    tangents = None if field is None else _tangents(field, level)
    vertices, normals = stage(
        token,
        lambda h, d, w: place_vertices(h, d, grid, w, tangents, cuts),
        hermite,
        dual,
        weight,
    )
    return dual_mesh(dual, vertices, normals, hermite.t, grid, capacity, token)


def hermite_data(field, values, dual: Dual, grid, level, token) -> Hermite:
    """Crossings and normals of all cut edges, from the field where there is one."""
    if field is None:
        return from_samples(values, dual.edges, grid, level, token)
    return from_field(field, values, dual.edges, dual.inside, grid, level)


class _Fit(eqx.Module):
    """The sums of the normal equations of all patches, in units of the widest side of
    a cell from its corner, and the points that fit them."""

    mean: Float[Array, "v 3"]
    normal: Float[Array, "v 3 3"]
    right: Float[Array, "v 3"]
    number: Float[Array, " v"]
    point: Float[Array, "v 3"]


def _fit_crossings(hermite: Hermite, patches: Patches, size, weight) -> _Fit:
    """The tangent planes of the crossings of every patch."""
    points = local_crossings(hermite.t, patches) * size
    normals = hermite.normals[patches.edge]
    held = patches.held[..., None].astype(points.dtype)
    number = jnp.maximum(jnp.sum(held, axis=0), 1.0)
    mean = jnp.sum(held * points, axis=0) / number
    offsets = jnp.sum(normals * (points - mean), axis=-1, keepdims=True)
    outer = normals[..., :, None] * normals[..., None, :]
    normal = jnp.sum(held[..., None] * outer, axis=0)
    right = jnp.sum(held * normals * offsets, axis=0)
    return _solved(_Fit(mean, normal, right, number[:, 0], mean), size, weight)


def _solved(fit: _Fit, size, weight) -> _Fit:
    number = fit.number[:, None]
    planes = Planes(fit.mean, fit.normal / number[..., None], fit.right / number)
    low, high = CLEARANCE * size, (1 - CLEARANCE) * size
    point = minimize_all(planes, low, high, weight, _STEPS)
    return eqx.tree_at(lambda f: f.point, fit, point)


def _cut_again(fit: _Fit, tangent, sound, size, weight, steps) -> _Fit:
    """The fit with the tangent planes of the field at its own points, `steps` times."""

    def step(fit, _):
        miss, normals = tangent(fit.point)
        used = sound & jnp.isfinite(miss) & (jnp.abs(miss) < 1)
        normals = jnp.where(used[:, None], normals, 0.0)
        miss = jnp.where(used, miss, 0.0)
        offset = jnp.sum(normals * (fit.point - fit.mean), axis=-1) - miss
        normal = fit.normal + normals[:, :, None] * normals[:, None, :]
        right = fit.right + normals * offset[:, None]
        cut = _Fit(fit.mean, normal, right, fit.number + used, fit.point)
        return _solved(cut, size, weight), None

    fit = lax.scan(step, fit, None, length=steps)[0]
    return eqx.tree_at(
        lambda f: f.point, fit, _projected(fit.point, tangent, sound, size)
    )


def _projected(points, tangent, sound, size):
    """Points moved onto the surface, in their cells: planes that meet outside of the
    cell leave them between the surface and the meeting point."""

    def step(points, _):
        miss, normals = tangent(points)
        used = sound & jnp.isfinite(miss) & (jnp.abs(miss) < 1)
        move = jnp.where(used[:, None], miss[:, None] * normals, 0.0)
        return jnp.clip(points - move, CLEARANCE * size, (1 - CLEARANCE) * size), None

    return lax.scan(step, points, None, length=_PROJECTIONS)[0]


def place_vertices(hermite: Hermite, dual: Dual, grid: Grid, weight, tangents, cuts):
    """The vertex and the mean normal of every patch.

    `tangents`: the distance of points to the surface and the normal there, to first
    order; or None, and no `cuts` are made.
    """
    patches = dual.patches
    scale = jnp.max(grid.spacing)
    size = grid.spacing / scale
    corner = grid.origin + grid.spacing * corner_indices(patches.node, grid.shape)
    fit = _fit_crossings(hermite, patches, size, weight)
    if tangents is not None:
        sound = jnp.all(hermite.sound[patches.edge] | ~patches.held, axis=0)

        def tangent(local):
            miss, normals = tangents(corner + scale * local)
            return miss / scale, normals

        fit = _cut_again(fit, tangent, sound, size, weight, cuts)
    held = patches.held[..., None].astype(corner.dtype)
    normals = jnp.sum(held * hermite.normals[patches.edge], axis=0)
    return corner + scale * fit.point, safe_normalize(normals)


def _tangents(field, level):
    """The signed distance of points to the surface, and its normal, to first order."""

    def at(points):
        values, slopes = jax.vmap(jax.value_and_grad(field))(points)
        steep = safe_norm(slopes)
        return safe_divide(values - level, steep), safe_normalize(slopes)

    return at


def local_crossings(t: Float[Array, " e"], patches: Patches) -> Float[Array, "k v 3"]:
    """The crossings of every patch in its cell, in [0, 1]^3."""
    axis, along = patches.code & 3, t[patches.edge]
    columns = [
        jnp.where(axis == d, along, (patches.code >> (2 + d) & 1).astype(t.dtype))
        for d in range(3)
    ]
    return jnp.stack(columns, axis=-1)
