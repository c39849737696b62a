"""The nouns: point clouds, meshes of triangles, polygons and tetrahedra, grids."""

from ._cloud import PointCloud as PointCloud
from ._cloud import stack as stack
from ._curvatures import Curvatures as Curvatures
from ._curvatures import PrincipalCurvatures as PrincipalCurvatures
from ._grid import Grid as Grid
from ._mesh import TriangleMesh as TriangleMesh
from ._polygons import PolygonMesh as PolygonMesh
from ._subsample import subsample as subsample
from ._tetrahedra import TetrahedralMesh as TetrahedralMesh
