"""Text files: delimiters, headers, columns told apart by their values."""

import numpy as np
import pytest

from jaxgeom.io import FileError, load_cloud

_RNG = np.random.default_rng(7)
_POINTS = np.round(_RNG.normal(size=(6, 3)) * 20, 4)
_NORMALS = _RNG.normal(size=(6, 3))
_NORMALS /= np.linalg.norm(_NORMALS, axis=1, keepdims=True)
_BYTES = _RNG.integers(0, 256, (6, 3))


def _write(path, table, delimiter=" ", head=""):
    rows = [delimiter.join(f"{v:.17g}" for v in row) for row in np.atleast_2d(table)]
    path.write_text(head + "\n".join(rows) + "\n")
    return path


@pytest.mark.parametrize("delimiter", [" ", ",", ", ", "\t", ";", "; ", "   "])
@pytest.mark.parametrize("form", ["xyz", "txt", "csv", "asc", "pts"])
def test_delimiters(tmp_path, delimiter, form):
    path = _write(tmp_path / f"a.{form}", _POINTS, delimiter)
    cloud = load_cloud(path)
    np.testing.assert_array_equal(cloud.points, _POINTS)
    assert cloud.points.dtype == np.float64
    assert cloud.normals is None and cloud.attributes == {}


def test_six_columns_are_normals_or_colors(tmp_path):
    path = tmp_path / "a.xyz"
    cloud = load_cloud(_write(path, np.hstack([_POINTS, _NORMALS])))
    np.testing.assert_array_equal(cloud.normals, _NORMALS)
    cloud = load_cloud(_write(path, np.hstack([_POINTS, _BYTES])))
    assert cloud.normals is None
    np.testing.assert_allclose(cloud.attributes["colors"], _BYTES / 255, atol=1e-7)
    cloud = load_cloud(_write(path, np.hstack([_POINTS, _BYTES / 255])))
    assert cloud.normals is None
    np.testing.assert_allclose(cloud.attributes["colors"], _BYTES / 255, atol=1e-7)


@pytest.mark.parametrize("colors_first", [False, True])
def test_nine_columns(tmp_path, colors_first):
    blocks = [_BYTES, _NORMALS] if colors_first else [_NORMALS, _BYTES]
    cloud = load_cloud(_write(tmp_path / "a.txt", np.hstack([_POINTS, *blocks])))
    np.testing.assert_array_equal(cloud.normals, _NORMALS)
    np.testing.assert_allclose(cloud.attributes["colors"], _BYTES / 255, atol=1e-7)


def test_four_and_seven_columns(tmp_path):
    extra = np.arange(6.0)[:, None] - 2
    cloud = load_cloud(_write(tmp_path / "a.txt", np.hstack([_POINTS, extra])))
    np.testing.assert_array_equal(cloud.attributes["column_4"], extra[:, 0])
    rows = np.hstack([_POINTS, extra - 99, _BYTES])
    cloud = load_cloud(_write(tmp_path / "a.pts", rows, head="6\n"))
    np.testing.assert_array_equal(cloud.attributes["column_4"], extra[:, 0] - 99)
    assert cloud.attributes["colors"].shape == (6, 3)


@pytest.mark.parametrize(
    "head, delimiter",
    [
        ("time,z,Y,x,NX,ny,nz\n", ","),
        ('"time";"z";"Y";"x";"NX";"ny";"nz"\n', ";"),
        ("# time z Y x NX ny nz\n", " "),
        ("//time,z,Y,x,NX,ny,nz\n", ","),
        ("# a title\n# time z y x normal_x normal_y normal_z\n\n", "\t"),
        ("\ufefftime,z,y,x,nx,ny,nz\r\n", ","),
    ],
)
def test_headers(tmp_path, head, delimiter):
    time = np.arange(6.0)[:, None]
    table = np.hstack([time, _POINTS[:, ::-1], _NORMALS])
    cloud = load_cloud(_write(tmp_path / "a.csv", table, delimiter, head))
    np.testing.assert_array_equal(cloud.points, _POINTS)
    np.testing.assert_array_equal(cloud.normals, _NORMALS)
    np.testing.assert_array_equal(cloud.attributes["time"], time[:, 0])


def test_decimal_commas(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("x;y;z\n1,5;2,25;-3,125\n4;5;6\n")
    points = load_cloud(path).points
    np.testing.assert_array_equal(points, [[1.5, 2.25, -3.125], [4, 5, 6]])
    path.write_text("1,5;2,25;-3,125\n4;5;6,5\n")
    np.testing.assert_array_equal(load_cloud(path).points[1], [4, 5, 6.5])


def test_one_point_and_far_points(tmp_path):
    path = tmp_path / "a.xyz"
    path.write_text("4123456.7891 -3987654.3211 12.0001")
    points = load_cloud(path).points
    np.testing.assert_array_equal(points, [[4123456.7891, -3987654.3211, 12.0001]])


@pytest.mark.parametrize(
    "text, says",
    [
        ("1 2 3\n4 five 6\n7 8 9\n", "line 2 of a.xyz .*five"),
        ("# c\n\n1 2 3\n4 5 6\n7 8\n", "line 5 of a.xyz must hold 3 numbers"),
        ("1 2 x\n4 5 6\n", "line 1 of a.xyz .*names x, y and z"),
        ("a,b,c\n1,2,3\n", "line 1 of a.xyz .*names x, y and z"),
        ("1,2,3\n4,,6\n", "line 2 of a.xyz"),
        ("x y z\n1 2 3 4\n", "line 2 of a.xyz must hold 3 numbers"),
        ("x y z\n", "at least one point"),
        ("# nothing\n\n", "at least one point"),
        ("1 2\n3 4\n", "three columns"),
        ("9\n1 2 3\n4 5 6\n", "promises 9 points, the file holds 2"),
        ("\0\1\2\3\n", "line 1"),
    ],
)
def test_bad_text(tmp_path, text, says):
    path = tmp_path / "a.xyz"
    path.write_text(text)
    with pytest.raises(FileError, match=says):
        load_cloud(path)


def test_every_cut_gives_fewer_points_or_a_file_error(tmp_path):
    table = np.hstack([_POINTS, _NORMALS])
    path = _write(tmp_path / "a.csv", table, ",", "x,y,z,nx,ny,nz\n")
    data = path.read_bytes()
    failed = 0
    for cut in range(len(data)):
        path.write_bytes(data[:cut])
        try:
            assert load_cloud(path).points.shape[0] <= 6
        except FileError:
            failed += 1
    assert failed > len(data) / 2
