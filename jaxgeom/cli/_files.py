"""A file that holds a mesh or a cloud, and a folder that holds a batch."""

import os

from .. import PointCloud, TriangleMesh
from .._core import message
from ..io import FileError, load_cloud, load_mesh


def load_shape(path) -> TriangleMesh | PointCloud:
    """The mesh of a file, or the points of a file without faces."""
    try:
        return load_mesh(path)
    except FileError:
        return load_cloud(path)


def check_folder(path) -> None:
    """Raise `FileError` where there is no folder of a batch."""
    if not os.path.isdir(os.path.join(path, "status")):
        must = f"{path} must be the folder of a batch"
        fix = "Pass what was --out of `jaxgeom batch`."
        raise FileError(message(must, "no folder 'status' in it", fix))
