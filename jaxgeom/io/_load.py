"""Read a point cloud or a mesh from any known file."""

import os

from ..shapes import PointCloud, TriangleMesh
from ._columns import Contents, to_cloud, to_mesh
from ._files import TEXT, read_file
from ._meshes import read_obj, read_off, read_stl
from ._numpy import read_npy, read_npz
from ._pcd import read_pcd
from ._ply_read import read_ply
from ._text import read_text
from ._trimesh import read_glb


def load_cloud(path: str | os.PathLike[str]) -> PointCloud:
    """The points of a file, with the normals, colors and other columns it holds.

    **Arguments:**

    - `path`: a PLY, PCD, NPY, NPZ, XYZ, TXT, CSV, ASC, PTS, OBJ, STL, OFF or GLB file,
      plain or gzipped. First bytes that are clear go before the extension. A mesh gives
      its vertices.

    Arrays are numpy's, on the host: float32 where the file has float32, float64 where
    it has doubles, integers or text. Nothing is rounded, so that coordinates far from
    the origin stay exact: subtract an offset in float64 before the first jax operation
    (`reconstruct` does). `attributes["colors"]` is float32 [n, 3] in [0, 1]; every
    other column is an attribute under its own name. The mask is all True, and points
    that are not finite are kept.

    Raises `FileError` for a file that is missing, empty, unknown, cut or damaged.

        cloud = load_cloud("scan.ply")
    """
    data, name, form = read_file(path)
    return to_cloud(_contents(data, name, form, faces=False), name)


def load_mesh(path: str | os.PathLike[str]) -> TriangleMesh:
    """The triangle mesh of a file, with the normals and colors of its vertices.

    **Arguments:**

    - `path`: a PLY, OBJ, STL, OFF, GLB or NPZ file, plain or gzipped.

    Polygons become fans of triangles; order and duplicates are kept, except in STL,
    whose corners at exactly equal places become one vertex. Precision, colors and
    attributes as in `load_cloud`.

    Raises `FileError` as `load_cloud` does, and for a file without faces or whose faces
    name vertices that do not exist.

        mesh = load_mesh("bunny.obj")
    """
    data, name, form = read_file(path)
    return to_mesh(_contents(data, name, form, faces=True), name)


_COLUMN_READERS = {
    "pcd": read_pcd,
    "npy": read_npy,
    **dict.fromkeys(TEXT, read_text),
}
_MESH_READERS = {
    "npz": read_npz,
    "obj": read_obj,
    "stl": read_stl,
    "off": read_off,
    "glb": read_glb,
}


def _contents(data, name, form, *, faces) -> Contents:
    if form == "ply":
        return read_ply(data, name, faces=faces)
    if form in _MESH_READERS:
        return _MESH_READERS[form](data, name)
    return Contents(_COLUMN_READERS[form](data, name))
