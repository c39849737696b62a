"""Between triangle meshes and meshes of polygons."""

from ..shapes import PolygonMesh, TriangleMesh


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
