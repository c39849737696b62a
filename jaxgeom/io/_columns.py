"""Named columns, the common form of all files, to and from the nouns."""

import re
from typing import NamedTuple

import numpy as np

from .._core import GeometryError, message
from ..shapes import PointCloud, TriangleMesh
from ._errors import FileError

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COLOR = ("red", "green", "blue")

_SPELLINGS = (
    POSITION,
    NORMAL,
    COLOR,
    ("normal_x", "normal_y", "normal_z"),
    ("normalx", "normaly", "normalz"),
    ("n_x", "n_y", "n_z"),
    ("r", "g", "b"),
    ("rf", "gf", "bf"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
)
# What PCD calls normals, packed colors and padding.
_PCD_NAMES = {"normal_x", "normal_y", "normal_z", "rgb", "rgba", "_"}
_MEANING = (POSITION, NORMAL, COLOR, NORMAL, NORMAL, NORMAL, COLOR, COLOR, COLOR)


class Contents(NamedTuple):
    """What a file holds: columns [n] or [n, k] by name, and faces where it has any."""

    columns: dict[str, np.ndarray]
    faces: np.ndarray | None = None


def canonical(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same columns, with positions, normals and colors under their usual names."""
    by_lower = {name.lower(): name for name in reversed(columns)}
    rename = {}
    for spelling, meaning in zip(_SPELLINGS, _MEANING, strict=True):
        taken = set(meaning) & set(rename.values())
        if not taken and all(s in by_lower for s in spelling):
            rename |= {by_lower[s]: m for s, m in zip(spelling, meaning, strict=True)}
    return {rename.get(name, name): column for name, column in columns.items()}


def to_cloud(contents: Contents, name: str) -> PointCloud:
    """The point cloud of a file's columns."""
    points, normals, attributes = _split(contents.columns, name)
    return PointCloud(points, normals, None, attributes)


def to_mesh(contents: Contents, name: str) -> TriangleMesh:
    """The triangle mesh of a file's columns and faces."""
    points, normals, attributes = _split(contents.columns, name)
    faces = contents.faces
    if faces is None or not len(faces):
        raise FileError(
            message(
                f"{name} must hold faces to be a mesh",
                f"{len(points)} points without a face",
                "Read it with load_cloud, and make a mesh with reconstruct.",
            )
        )
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(points):
        raise FileError(
            message(
                f"the faces of {name} must name vertices 0 to {len(points) - 1}",
                f"indices {low} to {high}",
                "Export the mesh again.",
            )
        )
    return TriangleMesh(points, faces.astype(np.int32), normals, attributes)


def of_cloud(cloud: PointCloud) -> dict[str, np.ndarray]:
    """The columns of the real points of one cloud."""
    if np.ndim(cloud.points) != 2:
        raise _batched(np.shape(cloud.points))
    keep = np.asarray(cloud.mask)
    pick = lambda x: np.asarray(x)[keep]
    normals = None if cloud.normals is None else pick(cloud.normals)
    attributes = {k: pick(v) for k, v in cloud.attributes.items()}
    return _join(pick(cloud.points), normals, attributes)


def of_mesh(mesh: TriangleMesh) -> Contents:
    """The columns and the faces of one mesh, without its padding."""
    if np.ndim(mesh.vertices) != 2:
        raise _batched(np.shape(mesh.vertices))
    mesh = mesh.trim()
    normals = None if mesh.normals is None else np.asarray(mesh.normals)
    attributes = {k: np.asarray(v) for k, v in mesh.attributes.items()}
    columns = _join(np.asarray(mesh.vertices), normals, attributes)
    return Contents(columns, np.asarray(mesh.faces))


def block(columns: dict[str, np.ndarray], names) -> np.ndarray | None:
    """The named columns side by side, or None where they are missing."""
    if not all(name in columns for name in names):
        return None
    return np.stack([columns[name] for name in names], axis=1)


def spread(name: str, value: np.ndarray) -> dict[str, np.ndarray]:
    """A [n] or [n, ...] array as columns `name`, or `name_0`, `name_1`, ..."""
    if value.ndim == 1:
        return {name: value}
    flat = value.reshape(len(value), int(np.prod(value.shape[1:])))
    return {f"{name}_{i}": flat[:, i] for i in range(flat.shape[1])}


def _split(columns, name):
    columns = canonical(columns)
    points = block(columns, POSITION)
    if points is None:
        raise FileError(
            message(
                f"{name} must hold the columns x, y and z",
                f"columns {', '.join(columns) or 'none'}",
                "Export the positions under these names.",
            )
        )
    if not len(points):
        raise FileError(
            message(
                f"{name} must hold at least one point",
                "0 points",
                "Check the program that wrote it.",
            )
        )
    normals, colors = block(columns, NORMAL), block(columns, COLOR)
    used = (*POSITION, *(() if normals is None else NORMAL))
    used = (*used, *(() if colors is None else COLOR))
    attributes = {k: v for k, v in columns.items() if k not in used}
    if colors is not None:
        attributes["colors"] = unit_colors(colors)
    normals = None if normals is None else _floating(normals)
    return _floating(points), normals, attributes


def unit_colors(colors: np.ndarray) -> np.ndarray:
    """Colors in [0, 1] as float32, from bytes, 16-bit numbers or fractions."""
    top = {"uint8": 255, "uint16": 65535}.get(colors.dtype.name)
    if top is None:
        peak = np.nanmax(colors, initial=0)
        top = 1 if peak <= 1 else 255 if peak <= 255 else 65535
    return np.clip(colors / np.float64(top), 0, 1).astype(np.float32)


def byte_colors(colors: np.ndarray) -> np.ndarray:
    """Colors as bytes, from fractions in [0, 1] or bytes."""
    if colors.dtype == np.uint8:
        return colors
    fractions = np.nan_to_num(np.asarray(colors, np.float64))
    return np.rint(255 * np.clip(fractions, 0, 1)).astype(np.uint8)


def _join(points, normals, attributes):
    columns = dict(zip(POSITION, _floating(points).T, strict=True))
    if normals is not None:
        columns |= zip(NORMAL, _floating(normals).T, strict=True)
    if not len(points):
        raise GeometryError(
            message("a file must hold at least one point", "0 points", "Save nothing.")
        )
    for name, value in attributes.items():
        is_color = name == "colors" and value.ndim == 2 and value.shape[1] in (3, 4)
        new = (
            dict(zip(COLOR, byte_colors(value)[:, :3].T, strict=True))
            if is_color
            else spread(name, _storable(name, value))
        )
        new = {_word(k): v for k, v in new.items()}
        clash = sorted(set(new) & (set(columns) | _PCD_NAMES))
        if clash:
            raise GeometryError(
                message(
                    "an attribute must not have the name of another column",
                    f"attribute {name!r}, which gives the column {clash[0]!r}",
                    "Rename the attribute.",
                )
            )
        columns |= new
    return columns


def _word(name):
    """A name that is one word in every format."""
    return re.sub(r"[\s,;]+", "_", name) or "unnamed"


def _floating(x):
    """Native float32 or float64: the one that holds the values without loss."""
    single = x.dtype.kind == "f" and x.dtype.itemsize == 4
    # bfloat16 is no numpy kind "f"; every narrow float fits a float32.
    narrow = x.dtype.kind not in "iub" and x.dtype.itemsize <= 2
    return np.ascontiguousarray(x, np.float32 if single or narrow else np.float64)


def _storable(name, value):
    if value.dtype.kind in "iub" or value.dtype in (np.float32, np.float64):
        return value.astype(np.uint8) if value.dtype == bool else value
    if value.dtype.kind not in "OSUcmMT" and value.dtype.itemsize <= 2:
        return value.astype(np.float32)
    raise GeometryError(
        message(
            "an attribute must hold real numbers to be saved",
            f"attribute {name!r} of dtype {value.dtype}",
            "Convert it, or leave it out.",
        )
    )


def _batched(shape):
    return GeometryError(
        message(
            "a file holds one object",
            f"a batch of shape {tuple(shape)}",
            "Save each element: jax.tree.map(lambda x: x[i], batch).",
        )
    )
