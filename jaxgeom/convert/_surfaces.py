"""From parametric surfaces to what is sampled from them."""

from jaxtyping import Array, Float

from ..fields import MeshDistance
from ..parametric import AbstractSurface, tessellate, tessellate_quads
from ..shapes import Grid, PointCloud, PolygonMesh, TriangleMesh
from ._clouds import vertices_to_cloud
from ._fields import mesh_to_field, mesh_to_grid


def surface_to_mesh(
    surface: AbstractSurface, resolution: tuple[int, int] = (32, 32)
) -> TriangleMesh:
    """The mesh of a surface with about `resolution` cells along u and v.

    Its vertices lie on the surface; between them it is off by the order of the square
    of a cell. Seams and poles are welded: see `parametric.tessellate`.
    """
    return tessellate(surface, resolution)


def surface_to_cloud(
    surface: AbstractSurface, resolution: tuple[int, int] = (32, 32)
) -> PointCloud:
    """Points on a surface, evenly in u and v, with its unit normals there."""
    return vertices_to_cloud(tessellate(surface, resolution))


def surface_to_field(
    surface: AbstractSurface, resolution: tuple[int, int] = (32, 32)
) -> MeshDistance:
    """The signed distance of the mesh of a closed surface, as a field.

    As near as the mesh is; `parametric.closest_point` knows the surface itself.
    """
    return mesh_to_field(tessellate(surface, resolution))


def surface_to_polygons(
    surface: AbstractSurface, resolution: tuple[int, int] = (32, 32)
) -> PolygonMesh:
    """The mesh of `surface_to_mesh` with its cells as quads, triangles at poles (host).

    See `parametric.tessellate_quads`.
    """
    return tessellate_quads(surface, resolution)


def surface_to_grid(
    surface: AbstractSurface, grid: Grid, resolution: tuple[int, int] = (32, 32)
) -> Float[Array, "x y z"]:
    """The signed distance [x, y, z] of the mesh of a closed surface at the nodes."""
    return mesh_to_grid(tessellate(surface, resolution), grid)
