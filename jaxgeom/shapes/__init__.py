"""The nouns: point clouds, triangle and polygon meshes, grids."""

from ._cloud import PointCloud as PointCloud
from ._cloud import stack as stack
from ._grid import Grid as Grid
from ._mesh import TriangleMesh as TriangleMesh
from ._polygons import PolygonMesh as PolygonMesh
from ._subsample import subsample as subsample
