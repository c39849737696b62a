"""PLY files as other programs write them."""

import itertools
import struct

import numpy as np
import pytest

from jaxgeom.io import FileError, load_cloud, load_mesh

_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">"}
_CODES = {
    "char": "b", "uchar": "B", "short": "h", "ushort": "H",
    "int": "i", "uint": "I", "float": "f", "double": "d",
    "float32": "f", "float64": "d", "uint8": "B", "int32": "i",
}  # fmt: skip
_FORMATS = ("ascii", *_ORDERS)


def encode(form, elements, newline="\n"):
    """A PLY file of elements (name, [(type, name) or (size, type, name)], rows)."""
    head = ["ply", f"format {form} 1.0", "comment made by hand", "obj_info 1 2 3"]
    body = b""
    for name, properties, rows in elements:
        head.append(f"element {name} {len(rows)}")
        for p in properties:
            words = ("list", *p) if len(p) == 3 else p
            head.append(f"property {' '.join(words)}")
        for row in rows:
            body += _row(form, properties, row, newline)
    return newline.join([*head, "end_header", ""]).encode() + body


def _row(form, properties, row, newline):
    if form == "ascii":
        words = []
        for p, value in zip(properties, row, strict=True):
            words += [len(value), *value] if len(p) == 3 else [value]
        return (" ".join(repr(w) for w in words) + newline).encode()
    out = b""
    for p, value in zip(properties, row, strict=True):
        order = _ORDERS[form]
        if len(p) == 3:
            out += struct.pack(order + _CODES[p[0]], len(value))
            out += struct.pack(order + _CODES[p[1]] * len(value), *value)
        else:
            out += struct.pack(order + _CODES[p[0]], value)
    return out


_COLUMNS = {
    ("double", "x"): [4e6 + 1e-4, 1.25, -3.0, 0.1],
    ("float", "y"): [0.5, 2.0, -0.25, 8.0],
    ("short", "z"): [1, -2, 300, 4],
    ("float", "nx"): [1.0, 0.0, 0.0, 0.5],
    ("float", "ny"): [0.0, 1.0, 0.0, 0.5],
    ("double", "nz"): [0.0, 0.0, 1.0, -0.5],
    ("uchar", "red"): [255, 0, 51, 102],
    ("uchar", "green"): [0, 255, 51, 102],
    ("uchar", "blue"): [5, 10, 15, 20],
    ("uint", "id"): [1, 2**32 - 1, 3, 4],
    ("char", "flag"): [-1, 1, 0, 7],
}


def _shuffled(seed):
    order = np.random.default_rng(seed).permutation(len(_COLUMNS))
    keys = [list(_COLUMNS)[i] for i in order]
    return keys, list(zip(*(_COLUMNS[k] for k in keys), strict=True))


@pytest.mark.parametrize("form", _FORMATS)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_any_order_of_properties(tmp_path, form, seed, newline):
    keys, rows = _shuffled(seed)
    path = tmp_path / "a.ply"
    path.write_bytes(encode(form, [("vertex", keys, rows)], newline))
    cloud = load_cloud(path)
    want = {name: np.array(values) for (_, name), values in _COLUMNS.items()}
    points = np.stack([want[k] for k in "xyz"], axis=1)
    np.testing.assert_array_equal(cloud.points, points)
    normals = np.stack([want[k] for k in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_array_equal(cloud.normals, normals)
    colors = np.stack([want[k] for k in ("red", "green", "blue")], axis=1) / 255
    np.testing.assert_allclose(cloud.attributes["colors"], colors, atol=1e-7)
    assert cloud.attributes["id"].dtype == np.uint32
    assert cloud.attributes["flag"].dtype == np.int8
    np.testing.assert_array_equal(cloud.attributes["id"], want["id"])
    np.testing.assert_array_equal(cloud.attributes["flag"], want["flag"])


_XYZ = [("float", "x"), ("float", "y"), ("float", "z")]
_ROWS = [(0.0, 0.0, 0.5), (1.0, 0.0, 0.25), (1.0, 1.0, 0.0), (0.0, 1.0, 2.0)]
_POLYGONS = {
    "triangles": [[0, 1, 2], [0, 2, 3]],
    "mixed": [[0, 1, 2, 3], [3, 2, 1], [2, 0], [1, 0, 3, 2]],
}
_FANS = {
    "triangles": [[0, 1, 2], [0, 2, 3]],
    "mixed": [[0, 1, 2], [0, 2, 3], [3, 2, 1], [1, 0, 3], [1, 3, 2]],
}


@pytest.mark.parametrize("form", _FORMATS)
@pytest.mark.parametrize("polygons", _POLYGONS)
@pytest.mark.parametrize("size", ["uchar", "int"])
@pytest.mark.parametrize("label", ["vertex_indices", "vertex_index"])
@pytest.mark.parametrize("first", [False, True])
def test_faces_lists_and_extra_elements(tmp_path, form, polygons, size, label, first):
    flags = [("uchar", "flag"), (size, "int", label), ("uchar", "float", "uv")]
    rows = [(7, p, [0.5] * i) for i, p in enumerate(_POLYGONS[polygons])]
    if polygons == "triangles":
        rows = [(7, p, [0.5, 0.25]) for _, p, _ in rows]
    faces = ("face", flags, rows)
    vertices = ("vertex", _XYZ, _ROWS)
    extra = ("edge", [("uchar", "short", "ends"), ("double", "w")], [([1, 2], 0.5)] * 3)
    strips = ("camera", [("float", "focal")], [(35.0,)])
    elements = [extra, faces, vertices] if first else [vertices, extra, faces]
    path = tmp_path / "a.ply"
    path.write_bytes(encode(form, [strips, *elements]))
    mesh = load_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, _ROWS)
    np.testing.assert_array_equal(mesh.faces, _FANS[polygons])
    np.testing.assert_array_equal(load_cloud(path).points, _ROWS)


@pytest.mark.parametrize("form", _FORMATS)
def test_every_type(tmp_path, form):
    for kind, axis in itertools.product(_CODES, "xyz"):
        properties = [(kind if name == axis else t, name) for t, name in _XYZ]
        rows = [(1, 2, 3), (4, 5, 6)]
        path = tmp_path / "a.ply"
        path.write_bytes(encode(form, [("vertex", properties, rows)]))
        cloud = load_cloud(path)
        np.testing.assert_array_equal(cloud.points, rows)
        assert cloud.points.dtype in (np.float32, np.float64)


def test_precision_follows_the_file(tmp_path):
    path = tmp_path / "a.ply"
    for kind, want in (("float", np.float32), ("double", np.float64)):
        properties = [(kind, name) for name in "xyz"]
        data = encode("binary_big_endian", [("vertex", properties, _ROWS)])
        path.write_bytes(data)
        assert load_cloud(path).points.dtype == want


def test_a_vertex_property_may_be_a_list(tmp_path):
    properties = [("uchar", "int", "seen"), *_XYZ]
    rows = [(list(range(i)), *row) for i, row in enumerate(_ROWS)]
    for form in _FORMATS:
        path = tmp_path / "a.ply"
        path.write_bytes(encode(form, [("vertex", properties, rows)]))
        np.testing.assert_array_equal(load_cloud(path).points, _ROWS)


@pytest.mark.parametrize("form", _FORMATS)
def test_every_cut_is_reported(tmp_path, form):
    keys, rows = _shuffled(1)
    faces = [("uchar", "int", "vertex_indices")]
    polygons = [([0, 1, 2],), ([0, 1, 2, 3],)]
    data = encode(form, [("vertex", keys, rows), ("face", faces, polygons)])
    path = tmp_path / "a.ply"
    # Text may lose its last digits or line break unseen.
    end = len(data) - (2 if form == "ascii" else 0)
    for cut in range(end):
        path.write_bytes(data[:cut])
        with pytest.raises(FileError):
            load_mesh(path)


@pytest.mark.parametrize("form", _FORMATS)
def test_broken_bytes_give_data_or_a_file_error(tmp_path, form):
    keys, rows = _shuffled(2)
    faces = [("uchar", "int", "vertex_indices")]
    polygons = [([0, 1, 2],), ([0, 1, 2, 3],)]
    data = encode(form, [("vertex", keys, rows), ("face", faces, polygons)])
    rng = np.random.default_rng(0)
    path = tmp_path / "a.ply"
    for _ in range(400):
        broken = bytearray(data)
        for place in rng.integers(4, len(data), 3):
            broken[place] = rng.integers(0, 256)
        path.write_bytes(broken)
        for load in (load_cloud, load_mesh):
            try:
                load(path)
            except FileError:
                pass


_HEAD = "ply\nformat ascii 1.0\n"


@pytest.mark.parametrize(
    "text, says",
    [
        ("ply\nelement vertex 1\nend_header\n", "no line 'format'"),
        (_HEAD + "element vertex 1\nproperty float x\n1\n", "no line 'end_header'"),
        (_HEAD + "element vertex -1\nproperty float x\nend_header\n", "vertex -1"),
        (_HEAD + "element vertex many\nend_header\n", "vertex many"),
        (_HEAD + "property float x\nend_header\n", "property float x"),
        (_HEAD + "element vertex 1\nproperty real x\nend_header\n1\n", "real x"),
        (_HEAD + "element face 0\nend_header\n", "no element 'vertex'"),
        ("ply\nformat zip 1.0\nend_header\n", "format zip"),
        (_HEAD + "nonsense\nend_header\n", "nonsense"),
        (
            _HEAD + "element vertex 1\nproperty float x\nproperty float y\n"
            "end_header\n1 2\n",
            "columns x, y and z; given: columns x, y",
        ),
    ],
)
def test_bad_headers(tmp_path, text, says):
    path = tmp_path / "a.ply"
    path.write_text(text)
    with pytest.raises(FileError) as error:
        load_cloud(path)
    assert says in str(error.value) and "a.ply" in str(error.value)


def test_counts_of_a_cut_body(tmp_path):
    path = tmp_path / "a.ply"
    whole = encode("binary_little_endian", [("vertex", _XYZ, _ROWS)])
    path.write_bytes(whole[:-13])
    with pytest.raises(FileError, match="promises 4 rows of 'vertex', .* holds 2"):
        load_cloud(path)
    text = encode("ascii", [("vertex", _XYZ, _ROWS)]).replace(b"vertex 4", b"vertex 9")
    path.write_bytes(text)
    with pytest.raises(FileError, match="promises 9 rows of 'vertex', .* holds 4"):
        load_cloud(path)
    huge = whole.replace(b"vertex 4", b"vertex 99999999999999999999")
    path.write_bytes(huge)
    with pytest.raises(FileError, match="promises 99999999999999999999"):
        load_cloud(path)


def test_a_word_in_the_body_is_named_with_its_line(tmp_path):
    path = tmp_path / "a.ply"
    lines = encode("ascii", [("vertex", _XYZ, _ROWS)]).split(b"\n")
    place = lines.index(b"end_header") + 3
    lines[place] = b"1.0 oops 2.0"
    path.write_bytes(b"\n".join(lines))
    with pytest.raises(FileError, match=f"line {place + 1} of a.ply .*oops"):
        load_cloud(path)


@pytest.mark.parametrize("index", [-1, 4, 2**31 - 1])
@pytest.mark.parametrize("form", _FORMATS)
def test_faces_must_name_vertices(tmp_path, form, index):
    faces = ("face", [("uchar", "int", "vertex_indices")], [([0, 1, index],)])
    path = tmp_path / "a.ply"
    path.write_bytes(encode(form, [("vertex", _XYZ, _ROWS), faces]))
    with pytest.raises(FileError, match="must name vertices 0 to 3"):
        load_mesh(path)
    assert load_cloud(path).points.shape == (4, 3)
