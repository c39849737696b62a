"""Pictures and pages as files, each written whole or not at all."""

import os
import pathlib
import struct
import tempfile
import zlib
from collections.abc import Sequence

import numpy as np

from .._core import GeometryError, message
from ..shapes import PointCloud, TriangleMesh

_GREY = (236, 238, 242)


def save_png(path, image: np.ndarray) -> pathlib.Path:
    """Write a picture uint8 [h, w, 3] as PNG (RFC 2083); returns the path.

    Raises `GeometryError` for an array of another shape or type.
    """
    image = np.asarray(image)
    if (
        image.dtype != np.uint8
        or image.ndim != 3
        or image.shape[2] != 3
        or 0 in image.shape
    ):
        raise GeometryError(
            message(
                "a picture must be uint8 of shape [h, w, 3]",
                f"{image.dtype} of shape {image.shape}",
                "Scale to 0...255 and convert with .astype('uint8').",
            )
        )
    return _write(path, _png(image))


def side_by_side(images: Sequence[np.ndarray], *, gap: int = 8) -> np.ndarray:
    """The pictures uint8 [h, w, 3] in one row, `gap` pixels apart, centered in height.

    Raises `GeometryError` for an empty list.
    """
    if not images:
        raise GeometryError(
            message("side_by_side needs a picture", "none", "Pass a list of pictures.")
        )
    height = max(image.shape[0] for image in images)
    width = sum(image.shape[1] for image in images) + gap * (len(images) - 1)
    row = np.full((height, width, 3), _GREY, np.uint8)
    left = 0
    for image in images:
        h, w = image.shape[:2]
        top = (height - h) // 2
        row[top : top + h, left : left + w] = image
        left += w + gap
    return row


def save_html(path, shape: TriangleMesh | PointCloud) -> pathlib.Path:
    """Write a page that shows a mesh or a cloud, to turn and zoom; returns the path.

    One file of about 0.7 MB beside the data, with everything inside: it needs a browser
    and no network (the viewer is trimesh's). Coordinates are stored in float32.
    """
    from trimesh.viewer.notebook import scene_to_html

    mesh = isinstance(shape, TriangleMesh)
    body = _mesh_body(shape.trim()) if mesh else _cloud_body(shape)
    return _write(path, scene_to_html(body.scene()).encode())


def _mesh_body(mesh):
    import trimesh

    normals = None if mesh.normals is None else np.asarray(mesh.normals)
    body = trimesh.Trimesh(
        np.asarray(mesh.vertices),
        np.asarray(mesh.faces),
        vertex_normals=normals,
        process=False,
    )
    body.visual.vertex_colors = _colors(mesh.attributes, len(mesh.vertices))
    return body


def _cloud_body(cloud):
    import trimesh

    real = np.asarray(cloud.mask)
    colors = _colors(cloud.attributes, len(real))
    return trimesh.PointCloud(np.asarray(cloud.points)[real], colors[real])


def _colors(attributes, count):
    clay = np.broadcast_to((0.80, 0.69, 0.58), (count, 3))
    colors = np.asarray(attributes.get("colors", clay))[:, :3]
    return np.round(255 * np.clip(colors, 0, 1)).astype(np.uint8)


def _png(image):
    height, width, _ = image.shape
    # Differences to the row above compress better than the colors (filter 2, "up").
    rows = np.diff(image.reshape(height, -1), axis=0, prepend=np.uint8(0))
    lines = np.concatenate([np.full((height, 1), 2, np.uint8), rows], axis=1)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    parts = [
        (b"IHDR", header),
        (b"IDAT", zlib.compress(lines.tobytes(), 9)),
        (b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*part) for part in parts)


def _chunk(kind, data):
    body = kind + data
    return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))


def _write(path, data: bytes) -> pathlib.Path:
    """Write under another name, then rename, so that no half file is ever seen."""
    path = pathlib.Path(path)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
    return path


def _umask():
    current = os.umask(0)
    os.umask(current)
    return current
