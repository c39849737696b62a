"""PCD files: text, binary, compressed, packed colors."""

import struct

import numpy as np
import pytest

from jaxgeom.io import FileError, load_cloud
from jaxgeom.io._lzf import decompress

_N = 40
_RNG = np.random.default_rng(2)
_POINTS = np.round(_RNG.normal(size=(_N, 3)), 2).astype(np.float32)
_NORMALS = np.tile(np.array([[0.0, 0.6, 0.8]], np.float32), (_N, 1))
_COLORS = _RNG.integers(0, 256, (_N, 3)).astype(np.uint32)
_RGB = (_COLORS[:, 0] << 16) | (_COLORS[:, 1] << 8) | _COLORS[:, 2]
_FPFH = _RNG.random((_N, 5)).astype(np.float32)
_LABEL = np.arange(_N, dtype=np.uint16)


def _compress(data):
    """A plain LZF encoder: literals, and references to the last equal three bytes."""
    out, literals, seen, i = b"", b"", {}, 0

    def flush():
        parts = [literals[k : k + 32] for k in range(0, len(literals), 32)]
        return b"".join(bytes([len(p) - 1]) + p for p in parts)

    while i < len(data):
        key = data[i : i + 3]
        start = seen.get(key, -1) if len(key) == 3 else -1
        seen[key] = i
        if start < 0 or i - start > 8192:
            literals += data[i : i + 1]
            i += 1
            continue
        length = 3
        while (
            i + length < len(data)
            and length < 264
            and data[start + length] == data[i + length]
        ):
            length += 1
        out, literals = out + flush(), b""
        high, low = divmod(i - start - 1, 256)
        short = length - 2
        if short < 7:
            out += bytes([(short << 5) | high, low])
        else:
            out += bytes([(7 << 5) | high, short - 7, low])
        i += length
    return out + flush()


def _pcd(encoding, rgb_type="U"):
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"
        "FIELDS x y z _ normal_x normal_y normal_z rgb fpfh label\n"
        f"SIZE 4 4 4 1 4 4 4 4 4 2\nTYPE F F F U F F F {rgb_type} F U\n"
        f"COUNT 1 1 1 4 1 1 1 1 5 1\nWIDTH {_N // 4}\nHEIGHT 4\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {_N}\nDATA {encoding}\n"
    ).encode()
    pad = np.zeros((_N, 4), np.uint8)
    rgb = _RGB.view(np.float32) if rgb_type == "F" else _RGB
    blocks = [*_POINTS.T, pad, *_NORMALS.T, rgb, _FPFH, _LABEL]
    if encoding == "binary":
        rows = [b"".join(np.asarray(b[i]).tobytes() for b in blocks) for i in range(_N)]
        return head + b"".join(rows)
    if encoding == "binary_compressed":
        raw = b"".join(np.ascontiguousarray(b).tobytes() for b in blocks)
        packed = _compress(raw)
        return head + struct.pack("<II", len(packed), len(raw)) + packed
    lines = []
    for i in range(_N):
        numbers = np.concatenate([np.atleast_1d(b[i]).astype(float) for b in blocks])
        lines.append(" ".join(f"{v:.17g}" for v in numbers))
    return head + ("\n".join(lines) + "\n").encode()


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("rgb_type", ["U", "F"])
def test_every_encoding(tmp_path, encoding, rgb_type):
    path = tmp_path / "a.pcd"
    path.write_bytes(_pcd(encoding, rgb_type))
    cloud = load_cloud(path)
    text = encoding == "ascii"
    assert cloud.points.dtype == (np.float64 if text else np.float32)
    np.testing.assert_array_equal(cloud.points, _POINTS)
    np.testing.assert_array_equal(cloud.normals, _NORMALS)
    np.testing.assert_array_equal(cloud.attributes["fpfh"], _FPFH)
    np.testing.assert_array_equal(cloud.attributes["label"], _LABEL)
    np.testing.assert_allclose(cloud.attributes["colors"], _COLORS / 255, atol=1e-7)
    assert set(cloud.attributes) == {"fpfh", "label", "colors"}


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_every_cut_is_reported(tmp_path, encoding):
    data = _pcd(encoding)
    path = tmp_path / "a.pcd"
    # A label of text may lose its last digit unseen.
    end = len(data) - (2 if encoding == "ascii" else 0)
    for cut in [*range(0, 400, 3), *range(400, end, 37), end - 1]:
        path.write_bytes(data[:cut])
        with pytest.raises(FileError):
            load_cloud(path)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_broken_bytes_give_data_or_a_file_error(tmp_path, encoding):
    data = _pcd(encoding)
    rng = np.random.default_rng(0)
    path = tmp_path / "a.pcd"
    for _ in range(300):
        broken = bytearray(data)
        for place in rng.integers(8, min(len(data), 700), 3):
            broken[place] = rng.integers(0, 256)
        path.write_bytes(broken)
        try:
            load_cloud(path)
        except FileError:
            pass


@pytest.mark.parametrize("size", [0, 1, 31, 32, 33, 264, 265, 9000])
@pytest.mark.parametrize("values", [1, 3, 256])
def test_lzf(size, values):
    data = np.random.default_rng(size).integers(0, values, size).astype(np.uint8)
    data = data.tobytes()
    assert decompress(_compress(data), size, "a") == data
    with pytest.raises(FileError):
        decompress(_compress(data), size + 1, "a")


@pytest.mark.parametrize(
    "old, new",
    [
        (b"SIZE 4 4 4 1 4 4 4 4 4 2", b"SIZE 4 4"),
        (b"TYPE F F F U", b"TYPE F F F Q"),
        (b"POINTS 40", b"POINTS many"),
        (b"POINTS 40", b"POINTS -4"),
        (b"FIELDS x y z", b"FIELDS a b c"),
        (b"FIELDS x y z", b"FIELDS x y y"),
        (b"DATA binary", b"DATA zipped"),
        (b"DATA binary", b"NOTHING"),
        (b"POINTS 40", b"POINTS 41"),
        (b"COUNT 1 1 1 4", b"COUNT 1 1 1 -4"),
        (b"COUNT 1 1 1 4", b"COUNT 1 1 1 99999999"),
        (b"SIZE 4 4 4 1", b"SIZE 4 4 4 4,f4"),
    ],
)
def test_bad_headers(tmp_path, old, new):
    path = tmp_path / "a.pcd"
    path.write_bytes(_pcd("binary").replace(old, new))
    with pytest.raises(FileError, match="a.pcd"):
        load_cloud(path)
