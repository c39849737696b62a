"""Columns as packed binary files: PLY and PCD."""

import numpy as np

from ._columns import COLOR, NORMAL, POSITION, Contents
from ._text import text_rows

_PLY_NAMES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort",
    "i4": "int", "u4": "uint", "f4": "float", "f8": "double",
}  # fmt: skip


def write_ply(contents: Contents) -> bytes:
    """A binary little-endian PLY file; float64 columns are `property double`."""
    columns = {k: _ply_typed(v) for k, v in contents.columns.items()}
    rows = _packed(columns)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment written by jaxgeom",
        f"element vertex {len(rows)}",
        *(f"property {_PLY_NAMES[v.dtype.str[1:]]} {k}" for k, v in columns.items()),
    ]
    faces = b""
    if contents.faces is not None:
        header += [
            f"element face {len(contents.faces)}",
            "property list uchar int vertex_indices",
        ]
        table = np.empty(len(contents.faces), [("n", "u1"), ("v", "<i4", (3,))])
        table["n"], table["v"] = 3, contents.faces
        faces = table.tobytes()
    return _encoded([*header, "end_header"]) + rows.tobytes() + faces


def write_pcd(columns: dict[str, np.ndarray]) -> bytes:
    """A PCD file (version 0.7), with colors packed as PCL does.

    Binary for float32 positions and normals; text with all digits for float64, since
    Open3D 0.20 reads binary doubles as zeros.
    """
    text = any(
        columns[k].dtype == np.float64 for k in (*POSITION, *NORMAL) if k in columns
    )
    if all(k in columns for k in COLOR):
        red, green, blue = (columns.pop(k).astype(np.uint32) for k in COLOR)
        columns["rgb"] = (red << 16) | (green << 8) | blue
    renamed = dict(zip(NORMAL, ("normal_x", "normal_y", "normal_z"), strict=True))
    columns = {renamed.get(k, k): v for k, v in columns.items()}
    rows = _packed(columns)
    kinds = {"f": "F", "i": "I", "u": "U"}
    sizes = [
        4 if text and v.dtype.kind == "f" else v.itemsize for v in columns.values()
    ]
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        f"FIELDS {' '.join(columns)}",
        f"SIZE {' '.join(map(str, sizes))}",
        f"TYPE {' '.join(kinds[v.dtype.kind] for v in columns.values())}",
        f"COUNT {' '.join('1' for _ in columns)}",
        f"WIDTH {len(rows)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}",
        "DATA ascii" if text else "DATA binary",
    ]
    return _encoded(header) + (text_rows(rows, " ") if text else rows.tobytes())


def _packed(columns):
    fields = [(k, v.dtype.newbyteorder("<")) for k, v in columns.items()]
    rows = np.empty(len(next(iter(columns.values()))), fields)
    for name, column in columns.items():
        rows[name] = column
    return rows


def _ply_typed(column):
    """PLY has no 64-bit integers: 32 bits where the values fit, else double."""
    if column.dtype.kind not in "iu" or column.dtype.itemsize < 8:
        return column
    limits = np.iinfo(np.int32)
    fits = column.min() >= limits.min and column.max() <= limits.max
    return column.astype(np.int32 if fits else np.float64)


def _encoded(lines):
    return ("\n".join(lines) + "\n").encode()
