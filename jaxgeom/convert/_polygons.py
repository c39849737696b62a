"""To meshes of polygons, and from them."""

from collections.abc import Callable

from jaxtyping import Array, Float, Key

from ..fields import MeshDistance
from ..isosurface import DualMarchingCubes, quads
from ..shapes import Grid, PointCloud, PolygonMesh, TriangleMesh
from ._clouds import cloud_to_grid, mesh_to_cloud
from ._fields import field_to_mesh, grid_to_mesh, mesh_to_field, mesh_to_grid

_DUAL = DualMarchingCubes()


def mesh_to_polygons(mesh: TriangleMesh) -> PolygonMesh:
    """The same faces as polygons of three corners (host: the padding is cut off).

    Exact but for vertex normals, which polygons do not carry.
    """
    return PolygonMesh.from_triangles(mesh)


def polygons_to_mesh(mesh: PolygonMesh) -> TriangleMesh:
    """Every face of k corners as a fan of k - 2 triangles.

    Exact for plane convex faces; others become the fan about their first corner, and
    which triangles belonged together is lost.
    """
    return mesh.triangulate()


def polygons_to_cloud(
    mesh: PolygonMesh, num: int, *, key: Key[Array, ""]
) -> PointCloud:
    """`num` points of the faces, uniform by area, with the normals of their triangles.

    See `mesh_to_cloud` and `polygons_to_mesh`.
    """
    return mesh_to_cloud(polygons_to_mesh(mesh), num, key=key)


def polygons_to_field(mesh: PolygonMesh) -> MeshDistance:
    """The signed distance of the triangles of a closed mesh of polygons, as a field."""
    return mesh_to_field(polygons_to_mesh(mesh))


def polygons_to_grid(mesh: PolygonMesh, grid: Grid) -> Float[Array, "x y z"]:
    """That signed distance [x, y, z] at the nodes of a grid."""
    return mesh_to_grid(polygons_to_mesh(mesh), grid)


def grid_to_polygons(
    values: Float[Array, "x y z"], grid: Grid, *, method=_DUAL, closed: bool = False
) -> PolygonMesh:
    """The surface where values at the nodes are zero, as quads (host).

    A quad around every edge of the grid that the surface cuts. `method` is
    `isosurface.DualMarchingCubes()` or `DualContouring()`. Empty where the values do
    not change their sign.
    """
    return quads(grid_to_mesh(values, grid, method=method, closed=closed).mesh)


def field_to_polygons(
    field: Callable, grid: Grid, *, method=_DUAL, closed: bool = False
) -> PolygonMesh:
    """The surface where a field is zero inside of a grid, as quads (host)."""
    return quads(field_to_mesh(field, grid, method=method, closed=closed).mesh)


def cloud_to_polygons(cloud: PointCloud, grid: Grid, *, method=None) -> PolygonMesh:
    """The zero surface of `cloud_to_field` as quads (host)."""
    return grid_to_polygons(cloud_to_grid(cloud, grid, method=method), grid)
