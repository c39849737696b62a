"""Between meshes, fields and samples of fields on a grid."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..fields import MeshDistance, Sampled, sample
from ..isosurface import Extraction, MarchingCubes, extract
from ..meshes import voxelize
from ..neighbors import AbstractSign, Pseudonormal
from ..shapes import Grid, TriangleMesh

_MARCHING_CUBES = MarchingCubes()
_PSEUDONORMAL = Pseudonormal()


def mesh_to_field(mesh: TriangleMesh) -> MeshDistance:
    """The signed distance of a closed mesh as a field: exact, O(faces) per point."""
    return MeshDistance(mesh)


def mesh_to_grid(
    mesh: TriangleMesh, grid: Grid, *, sign: AbstractSign = _PSEUDONORMAL
) -> Float[Array, "x y z"]:
    """The signed distance [x, y, z] of a mesh at the nodes of a grid.

    Exact at the nodes; between them details below the spacing are lost. `sign` is
    `neighbors.Pseudonormal()` for closed meshes or `Winding()` for any.
    """
    return voxelize(mesh, grid, sign=sign)


def field_to_grid(field: Callable, grid: Grid) -> Float[Array, "x y z"]:
    """The values [x, y, z] of a field at the nodes of a grid: exact at the nodes."""
    return sample(field, grid)


def grid_to_field(values: Float[Array, "x y z"], grid: Grid) -> Sampled:
    """The trilinear interpolant of values at the nodes: exact at the nodes."""
    return Sampled(grid, jnp.asarray(values))


def field_to_mesh(
    field: Callable, grid: Grid, *, method=_MARCHING_CUBES, closed: bool = False
) -> Extraction:
    """The mesh where a field is zero inside of a grid (host). See `isosurface.extract`.

    The error falls with the square of the spacing where the field is smooth.
    """
    return extract(field, grid, method=method, closed=closed)


def grid_to_mesh(
    values: Float[Array, "x y z"],
    grid: Grid,
    *,
    method=_MARCHING_CUBES,
    closed: bool = False,
) -> Extraction:
    """The mesh where the interpolant of values is zero (host).

    Vertices lie on the edges of the grid, exactly where the interpolant is zero there.
    """
    return extract(values, grid, method=method, closed=closed)
