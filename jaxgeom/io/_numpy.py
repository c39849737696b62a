"""NPY and NPZ, the files of numpy."""

import io

import numpy as np

from .._core import message
from ._columns import COLOR, NORMAL, POSITION, Contents, spread
from ._errors import FileError, damaged
from ._text import guess_columns

_POINTS = ("points", "vertices", "xyz", "positions", "pos")
_NORMALS = ("normals", "vertex_normals")
_COLORS = ("colors", "rgb", "vertex_colors")
_FACES = ("faces", "triangles")
RESERVED = {*_POINTS, *_NORMALS, *_COLORS, *_FACES} - {"colors"}


def read_npy(data: bytes, name: str) -> dict[str, np.ndarray]:
    """The columns of one array [n, 3 or more], or of a structured array [n]."""
    array = _decoded(data, name, "NPY")
    if array.dtype.names and array.ndim == 1:
        return {field: array[field] for field in array.dtype.names}
    _check_numbers(array, name, "NPY")
    return guess_columns(array, name)


def read_npz(data: bytes, name: str) -> Contents:
    """The columns and faces of named arrays.

    Positions are `points` or `vertices` (or xyz, positions, pos), else the only array
    [n, 3 or more] in the file. `normals`, `colors` and `faces` are known by name;
    other arrays [n, ...] become attributes.
    """
    arrays = _decoded(data, name, "NPZ")
    key = _points_key(arrays)
    if key is None:
        found = ", ".join(f"{k} {v.shape}" for k, v in arrays.items()) or "none"
        raise FileError(
            message(
                f"{name} must hold an array 'points' or 'vertices' of shape [n, 3]",
                f"arrays {found}",
                "Save it with numpy.savez(path, points=..., normals=...).",
            )
        )
    points = arrays.pop(key)
    _check_numbers(points, name, "NPZ")
    columns = guess_columns(points, name)
    faces = None
    for label, value in arrays.items():
        if label in _FACES:
            faces = _faces(value, name)
        elif value.ndim and len(value) == len(points) and value.dtype.kind in "fiub":
            columns |= _columns_of(label, value)
    return Contents(columns, faces)


def write_npy(columns: dict[str, np.ndarray]) -> bytes:
    """One structured array with a field per column, or [n, 3] for positions alone."""
    if set(columns) == set(POSITION):
        array = np.stack([columns[k] for k in POSITION], axis=1)
    else:
        array = np.empty(len(columns["x"]), [(k, v.dtype) for k, v in columns.items()])
        for label, column in columns.items():
            array[label] = column
    out = io.BytesIO()
    np.save(out, array, allow_pickle=False)
    return out.getvalue()


def write_npz(arrays: dict[str, np.ndarray]) -> bytes:
    """The named arrays, as they are."""
    out = io.BytesIO()
    np.savez_compressed(out, allow_pickle=False, **arrays)
    return out.getvalue()


def _decoded(data, name, form):
    # numpy and zipfile document no common error: whatever they raise means that
    # these bytes are no arrays.
    try:
        with np.errstate(all="ignore"):
            loaded = np.load(io.BytesIO(data), allow_pickle=False)
            if isinstance(loaded, np.ndarray):
                return loaded
            return {key: np.asarray(loaded[key]) for key in loaded.files}
    except Exception as error:
        raise damaged(name, form, str(error) or type(error).__name__) from error


def _points_key(arrays):
    tables = {
        k: v
        for k, v in arrays.items()
        if v.ndim == 2 and v.shape[1] >= 3 and v.dtype.kind in "fiu"
    }
    for key in _POINTS:
        if key in tables:
            return key
    known = (*_NORMALS, *_COLORS, *_FACES)
    free = [k for k, v in tables.items() if k not in known and v.dtype.kind == "f"]
    return free[0] if len(free) == 1 else None


def _columns_of(label, value):
    triple = value.ndim == 2 and value.shape[1] in (3, 4)
    if label in _NORMALS and triple:
        return dict(zip(NORMAL, value.T, strict=False))
    if label in _COLORS and triple:
        return dict(zip(COLOR, value.T[:3], strict=True))
    return {label: value} if label not in POSITION else spread(f"{label}_", value)


def _faces(value, name):
    if value.ndim != 2 or value.shape[1] != 3 or value.dtype.kind not in "iu":
        given = f"faces of shape {value.shape} and dtype {value.dtype}"
        raise damaged(name, "NPZ", given)
    return np.where(value < 2**31, value, -1).astype(np.int64)


def _check_numbers(array, name, form):
    if array.dtype.kind not in "fiub":
        raise damaged(name, form, f"an array of dtype {array.dtype}")
