"""Derivatives and new positions of a mesh whose faces stay as they are.

A surface that moves without changing its topology needs no new extraction.

- `refresh`: the vertices of marching cubes lie on edges of the grid; on the same edges,
  with other values, they lie elsewhere. Cheap, to be batched over thousands of values.
- `follow`: a point x with f(x, q) = level keeps its value as the parameters q of the
  field move if dx . grad f = -(df/dq) dq. The shortest such dx is along the normal
  n = grad f / |grad f|: dx = -(df/dq) dq n / |grad f| (implicit function theorem). It
  asks nothing of the extractor: its errors of interpolation have no part in it.

Where the topology changes there is no derivative, and these have none either.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from .._core import RESULTS, failure_where, first_failure, safe_divide
from ..shapes import Grid, TriangleMesh
from ._ambiguity import SeparateInside
from ._classify import classify
from ._extraction import Capacity, Extraction
from ._hermite import CLEARANCE
from ._marching_cubes import as_float, check_grid, marching_cubes
from ._placement import AbstractPlacement, Linear
from ._vertices import CutEdges, Samples, find_edges, positions

_LINEAR = Linear()
_SEPARATE = SeparateInside()


class Frozen(eqx.Module):
    """An extraction by marching cubes, and the cut edges that its vertices lie on."""

    extraction: Extraction
    edges: CutEdges


def freeze(
    values: Float[Array, "x y z"],
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    capacity: Capacity,
    token: Bool[Array, ""] | None = None,
) -> Frozen:
    """The mesh of `marching_cubes`, without normals, ready for `refresh`.

    Arguments, statuses and errors as there.
    """
    values, level = as_float(values, level)
    out = marching_cubes(
        values, grid, level, capacity=capacity, normals=False, token=token
    )
    fixed = lax.stop_gradient((values, level))
    bits, numbers = classify(*fixed, _SEPARATE, token)
    edges = find_edges(bits, numbers, values.shape[2], capacity.vertices, token)
    return Frozen(out, edges)


def refresh(
    frozen: Frozen,
    values: Float[Array, "x y z"],
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    placement: AbstractPlacement = _LINEAR,
) -> Extraction:
    """The frozen mesh with its vertices where other values of the field put them.

    Equal to `marching_cubes` of these values as long as the same nodes are inside. The
    derivatives are those of marching cubes. Batch over values, level or grid with
    `jax.vmap(refresh, in_axes=(None, 0, None))`.

    **Arguments:** `values` on a grid of the same shape; `placement` as there.

    **Statuses:** those of the frozen extraction; `no_surface` where the values do not
    change sign along one of the edges: its vertex is held at an end, and the topology
    is no longer that of the values.

    Raises `GeometryError` unless `values` has the shape of the grid.
    """
    values, level = as_float(values, level)
    check_grid(values, grid)
    samples = Samples(values, frozen.edges)
    mesh = frozen.extraction.mesh
    changed = (samples.along(0) < level) == (samples.along(1) < level)
    lost = jnp.any(changed & mesh.vertex_mask)
    t = jnp.clip(placement(samples, level), CLEARANCE, 1 - CLEARANCE)
    vertices = positions(t, frozen.edges, grid)
    vertices = jnp.where(mesh.vertex_mask[:, None], vertices, 0.0)
    result = first_failure(
        frozen.extraction.result, failure_where(lost, RESULTS.no_surface)
    )
    out = eqx.tree_at(lambda e: e.mesh.vertices, frozen.extraction, vertices)
    return eqx.tree_at(lambda e: e.result, out, result)


def follow(
    mesh: TriangleMesh, field: Callable, level: Float[Array, ""] | float = 0.0
) -> TriangleMesh:
    """The mesh as it is, whose vertices move with the surface of the field.

    The vertices keep their values; their derivative is -(df/dq) n / |grad f|, q being
    the parameters of `field` and the level, at the place where they are. Derivatives of
    what was computed before, through the extractor, are dropped: for a mesh of any
    extractor, on a surface that is smooth there. Zero where the gradient vanishes.

    **Arguments:**

    - `mesh`: vertices on or near the surface; `project` brings them onto it.
    - `field`: a function of one point [3], whose parameters are differentiated.

        radius_slope = jax.grad(lambda r: volume(follow(mesh, Sphere(r))))(0.7)
    """
    points = lax.stop_gradient(mesh.vertices)
    values, slopes = jax.vmap(jax.value_and_grad(field))(points)
    miss = values - level
    slopes = lax.stop_gradient(slopes)
    steep = jnp.sum(slopes**2, axis=-1)
    along = safe_divide(slopes, jnp.broadcast_to(steep[:, None], slopes.shape))
    moved = points - (miss - lax.stop_gradient(miss))[:, None] * along
    vertices = jnp.where(mesh.vertex_mask[:, None], moved, 0.0)
    return eqx.tree_at(lambda m: m.vertices, mesh, vertices)
