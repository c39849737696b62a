"""Write a point cloud or a mesh, all of it or nothing."""

import os
import warnings

import numpy as np

from .._core import GeometryError, message
from ..shapes import PointCloud, TriangleMesh
from ._binary import write_pcd, write_ply
from ._columns import COLOR, NORMAL, POSITION, Contents, block, of_cloud, of_mesh
from ._files import CLOUD_FORMATS, MESH_FORMATS, check_extension, write_file
from ._meshes import write_obj, write_off, write_stl
from ._numpy import RESERVED, write_npy, write_npz
from ._text import write_text
from ._trimesh import write_glb


def save_cloud(path: str | os.PathLike[str], cloud: PointCloud) -> None:
    """Write the real points of one cloud, with normals, colors and attributes.

    **Arguments:**

    - `path`: ends in ply, pcd, npy, npz, csv, xyz, txt, asc, pts, xyzn or xyzrgb; a
      further `.gz` compresses.
    - `cloud`: one cloud, not a batch.

    PLY is binary: float64 data are written as doubles, float32 as floats. PCD is binary
    for float32 and text for float64, since some programs misread binary doubles.
    Colors become bytes. Attributes [n, k] become the columns `name_0`, `name_1`, ...;
    NPZ alone keeps their shapes. The file appears complete or not at all. Raises
    `FileError` for an unknown extension or a path that cannot be written,
    `GeometryError` for a cloud that no file can hold.

        save_cloud("scan.ply", cloud)
    """
    form, zipped = check_extension(path, CLOUD_FORMATS)
    columns = of_cloud(cloud)
    if form == "ply":
        data = write_ply(Contents(columns))
    elif form == "pcd":
        data = write_pcd(columns)
    elif form == "npy":
        data = write_npy(columns)
    elif form == "npz":
        data = write_npz(_arrays("points", columns, cloud.trim().attributes))
    else:
        data = write_text(columns, form)
    write_file(path, data, zipped=zipped)


def save_mesh(path: str | os.PathLike[str], mesh: TriangleMesh) -> None:
    """Write one mesh without its padding.

    **Arguments:**

    - `path`: ends in ply, obj, stl, off, glb or npz; a further `.gz` compresses.
    - `mesh`: one mesh, not a batch.

    PLY and NPZ hold everything, OBJ and GLB normals and colors, OFF and STL positions
    and faces alone. Positions keep their precision, save in STL and GLB, which are
    float32: a warning says where that, or leaving something out, loses data. The file
    appears complete or not at all. Raises as `save_cloud` does.

        save_mesh("bunny.glb", mesh)
    """
    form, zipped = check_extension(path, MESH_FORMATS)
    contents = of_mesh(mesh)
    _warn_of_loss(form, contents.columns)
    if form == "npz":
        attributes = mesh.trim().attributes
        arrays = _arrays("vertices", contents.columns, attributes)
        data = write_npz(arrays | {"faces": contents.faces})
    else:
        data = _WRITERS[form](contents)
    write_file(path, data, zipped=zipped)


_WRITERS = {
    "ply": write_ply,
    "obj": write_obj,
    "stl": write_stl,
    "off": write_off,
    "glb": write_glb,
}
_HELD = {"obj": (*NORMAL, *COLOR), "glb": (*NORMAL, *COLOR), "off": (), "stl": ()}


def _arrays(label, columns, attributes):
    clash = sorted(RESERVED & set(attributes))
    if clash:
        raise GeometryError(
            message(
                "an attribute in an NPZ file must not have a name with a meaning",
                f"attribute {clash[0]!r}",
                "Rename the attribute.",
            )
        )
    arrays = {label: block(columns, POSITION), "normals": block(columns, NORMAL)}
    arrays = {k: v for k, v in arrays.items() if v is not None}
    return arrays | {k: np.asarray(v) for k, v in attributes.items()}


def _warn_of_loss(form, columns):
    if form in _HELD:
        left_out = [k for k in columns if k not in (*POSITION, *_HELD[form])]
        if left_out:
            _warn(f"{form} files do not hold {', '.join(left_out)}")
    if form in ("stl", "glb"):
        points = block(columns, POSITION)
        with np.errstate(invalid="ignore"):
            lost = np.nanmax(np.abs(points - points.astype(np.float32)))
            extent = np.nanmax(np.ptp(points, axis=0))
        # Half of the digits of a float32 must remain within the extent of the shape.
        if lost > extent * np.sqrt(np.finfo(np.float32).eps):
            _warn(f"{form} files are float32: positions are off by up to {lost:.2g}")


def _warn(what):
    text = message("the saved file should hold the whole mesh", what, "Save as ply.")
    warnings.warn(text, stacklevel=4)
