"""Bytes from and to the disk, and which format they are in."""

import gzip
import os
import re
import uuid
import zlib
from pathlib import Path

from .._core import message
from ._errors import FileError, damaged

TEXT = ("xyz", "txt", "csv", "asc", "pts", "xyzn", "xyzrgb")
CLOUD_FORMATS = ("ply", "pcd", "npy", "npz", *TEXT)
MESH_FORMATS = ("ply", "obj", "stl", "off", "glb", "npz")
READABLE = tuple(dict.fromkeys(CLOUD_FORMATS + MESH_FORMATS))

_MAGIC = (
    (re.compile(rb"ply[ \t]*[\r\n]"), "ply"),
    (re.compile(rb"\x93NUMPY"), "npy"),
    (re.compile(rb"PK\x03\x04"), "npz"),
    (re.compile(rb"glTF"), "glb"),
    (re.compile(rb"#[ \t]*\.PCD", re.I), "pcd"),
    (re.compile(rb"(ST)?C?N?OFF\b"), "off"),
    (re.compile(rb"\s*solid\b[^\0]*?\bfacet\b"), "stl"),
)
_GZIP = b"\x1f\x8b"
_STL_PREFIX, _STL_RECORD = 84, 50


def read_file(path) -> tuple[bytes, str, str]:
    """The contents (unzipped), the short name, and the format of the file at `path`."""
    data, name = _read_bytes(path), _short_name(path)
    if data.startswith(_GZIP):
        data = _unzip(data, name)
    if not data:
        raise FileError(
            message(
                f"{name} must hold data",
                "an empty file (0 bytes)",
                "Check the program that wrote it.",
            )
        )
    return data, name, _format_of(data, name)


def extension(path) -> tuple[str, bool]:
    """The lower-case extension without the dot, and whether `.gz` follows it."""
    suffixes = [s.lower() for s in Path(os.fspath(path)).suffixes]
    zipped = suffixes[-1:] == [".gz"]
    suffixes = suffixes[:-1] if zipped else suffixes
    return (suffixes[-1][1:] if suffixes else ""), zipped


def check_extension(path, known: tuple[str, ...]) -> tuple[str, bool]:
    """As `extension`, for a file to be written in one of the `known` formats."""
    form, zipped = extension(path)
    if form not in known:
        raise _unknown(_short_name(path), form, known)
    return form, zipped


def write_file(path, data: bytes, *, zipped: bool = False) -> None:
    """Write all of `data` or nothing: to a temporary neighbor, then renamed."""
    # A fixed time stamp makes equal data give equal files.
    data = gzip.compress(data, mtime=0) if zipped else data
    try:
        target = Path(os.path.realpath(os.fspath(path)))
        if target.is_dir():
            raise IsADirectoryError(21, "it is a folder")
        temporary = target.with_name(f".{uuid.uuid4().hex}.tmp")
        try:
            with open(temporary, "xb") as file:
                file.write(data)
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
    except (OSError, ValueError) as error:
        raise FileError(
            message(
                f"{_short_name(path)} must be writable",
                _reason(error),
                "Choose a file name in an existing folder that you may write to.",
            )
        ) from error


def _read_bytes(path) -> bytes:
    try:
        return Path(os.fspath(path)).read_bytes()
    except (OSError, ValueError) as error:
        raise FileError(
            message(
                f"{_short_name(path)} must be a readable file",
                _reason(error),
                "Check the path and its permissions.",
            )
        ) from error


def _unzip(data, name):
    try:
        return gzip.decompress(data)
    except (EOFError, OSError, zlib.error) as error:
        raise damaged(name, "gzip", str(error)) from error


def _format_of(data: bytes, name: str) -> str:
    """The format by the first bytes where these are clear, else by the extension."""
    for pattern, form in _MAGIC:
        if pattern.match(data[:4096]):
            return form
    form, _ = extension(name)
    if form in READABLE:
        return form
    if _is_binary_stl(data):
        return "stl"
    raise _unknown(name, form, READABLE)


def _is_binary_stl(data):
    count = int.from_bytes(data[80:84], "little")
    return count > 0 and len(data) == _STL_PREFIX + _STL_RECORD * count


def _unknown(name, form, known):
    return FileError(
        message(
            f"{name} must be in one of the formats {', '.join(known)}",
            f"extension .{form}" if form else "no extension",
            "Convert it, for example with CloudCompare or MeshLab, or rename it.",
        )
    )


def _short_name(path) -> str:
    return Path(os.fspath(path)).name or os.fspath(path)


def _reason(error) -> str:
    return getattr(error, "strerror", None) or str(error)
