"""A file that holds a mesh or a cloud."""

from .. import PointCloud, TriangleMesh
from ..io import FileError, load_cloud, load_mesh


def load_shape(path) -> TriangleMesh | PointCloud:
    """The mesh of a file, or the points of a file without faces."""
    try:
        return load_mesh(path)
    except FileError:
        return load_cloud(path)
