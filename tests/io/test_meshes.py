"""OBJ, OFF, STL and GLB files, with trimesh as a peer."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh

from jaxgeom import GeometryError
from jaxgeom.io import (
    FileError,
    from_trimesh,
    load_cloud,
    load_mesh,
    save_mesh,
    to_trimesh,
)
from jaxgeom.shapes import PointCloud, TriangleMesh


def _peer():
    shape = trimesh.creation.torus(0.7, 0.23, major_sections=9, minor_sections=7)
    shape.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    shape.vertices = shape.vertices.astype(np.float32)
    return shape


@pytest.mark.parametrize("form", ["ply", "obj", "off", "stl", "stl_ascii", "glb"])
def test_reads_what_trimesh_writes(tmp_path, form):
    peer = _peer()
    path = tmp_path / f"a.{form.split('_')[0]}"
    peer.export(path, file_type=form)
    mesh = load_mesh(path)
    # The exporters of trimesh round text to 8 digits.
    near = dict(atol=2e-8)
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    np.testing.assert_allclose(corners, peer.triangles, **near)
    assert mesh.vertices.shape == peer.vertices.shape
    assert load_cloud(path).points.shape == peer.vertices.shape


@pytest.mark.parametrize("form", ["ply", "obj", "off", "stl", "glb"])
def test_trimesh_reads_what_is_written(tmp_path, form):
    peer = _peer()
    path = tmp_path / f"a.{form}"
    save_mesh(path, from_trimesh(peer))
    back = trimesh.load_mesh(path)
    assert back.is_watertight and back.euler_number == peer.euler_number == 0
    assert abs(back.volume - peer.volume) < 1e-6
    assert abs(back.area - peer.area) < 1e-5


_OBJ = """
# a square of two textured triangles with a seam, and hard normals
mtllib none.mtl
v 0 0 0 1 0 0
v 1 0 0 0 1 0
v 1 1 0 0 0 1
v 0 1 0 1 1 1
vt 0 0
vn 0 0 1
vn 0 1 0
usemtl red
f 1/1/1 2/1/1 3/1/1 4/1/1
f -4//2 -2//2 \\
-1//2
"""


def test_obj(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text(_OBJ)
    mesh = load_mesh(path)
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    np.testing.assert_array_equal(mesh.vertices, square)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 2, 3]])
    diagonal = np.sqrt(0.5)
    np.testing.assert_allclose(mesh.normals[1], [0, 0, 1])
    np.testing.assert_allclose(mesh.normals[3], [0, diagonal, diagonal])
    np.testing.assert_array_equal(mesh.attributes["colors"][1], [0, 1, 0])


def test_obj_of_points_keeps_normals(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 1 2 3\nv 4 5 6\nvn 0 0 1\nvn 0 1 0\n")
    cloud = load_cloud(path)
    np.testing.assert_array_equal(cloud.points, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(cloud.normals, [[0, 0, 1], [0, 1, 0]])
    with pytest.raises(FileError, match="must hold faces"):
        load_mesh(path)


@pytest.mark.parametrize(
    "text, says",
    [
        ("v 1 2 3\nv 1 2\n", "line 2 of a.obj"),
        ("v 1 2 3\nv 1 b 3\n", "line 2 of a.obj .*b 3"),
        ("v 1 2 3\nv 1 2 3\nv 1 2 3\nf 1 2 3\nf 1 2 9\n", "name vertices 0 to 2"),
        ("v 1 2 3\nv 1 2 3\nv 1 2 3\nf 1 2 0\n", "line 4"),
        ("v 1 2 3\nv 1 2 3\nv 1 2 3\nf 1 2\n", "line 4"),
        ("v 1 2 3\nv 1 2 3\nv 1 2 3\nf -9 2 3\n", "name vertices 0 to 2"),
        ("v 1 2 3\nv 1 2 3\nv 1 2 3\nf 1//7 2//7 3//7\nvn 0 0 1\n", "out of range"),
        ("v 1 2 3\nv 1 2 3 4\n", "lines of 3 and of 4"),
        (f"v 1 2 3\nv 1 2 3\nv 1 2 3\nf 1 2 {10**30}\n", "name vertices"),
        ("g nothing\n", "at least one point"),
    ],
)
def test_bad_obj(tmp_path, text, says):
    path = tmp_path / "a.obj"
    path.write_text(text)
    with pytest.raises(FileError, match=says):
        load_mesh(path)


def test_off_with_normals_colors_and_polygons(tmp_path):
    path = tmp_path / "a.off"
    path.write_text(
        "CNOFF # both\n# a comment\n4 2 0\n\n"
        "0 0 0 0 0 1 255 0 0 255\n1 0 0 0 0 1 0 255 0 255\n"
        "1 1 0 0 0 1 0 0 255 255\n0 1 0 0 1 0 51 51 51 255\n"
        "4 0 1 2 3 200 100 0\n3 0 2 3\n"
    )
    mesh = load_mesh(path)
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 2, 3]])
    np.testing.assert_array_equal(mesh.normals[3], [0, 1, 0])
    np.testing.assert_allclose(mesh.attributes["colors"][3], [0.2] * 3)


@pytest.mark.parametrize("form", ["off", "stl", "stl_ascii", "glb", "ply"])
def test_every_cut_is_reported(tmp_path, form):
    path = tmp_path / f"a.{form.split('_')[0]}"
    _peer().export(path, file_type=form)
    data = path.read_bytes()
    # Text may lose the last letters of its last word unseen.
    end = len(data.rstrip()) - (0 if form in ("stl", "glb", "ply") else 12)
    for cut in [*range(0, 120, 7), *range(120, end, 211), end - 1]:
        path.write_bytes(data[:cut])
        with pytest.raises(FileError):
            load_mesh(path)


@pytest.mark.parametrize("form", ["off", "stl", "stl_ascii", "glb", "obj", "ply"])
def test_broken_bytes_give_data_or_a_file_error(tmp_path, form):
    path = tmp_path / f"a.{form.split('_')[0]}"
    _peer().export(path, file_type=form)
    data = path.read_bytes()
    rng = np.random.default_rng(0)
    for _ in range(60):
        broken = bytearray(data)
        for place in rng.integers(0, len(data), 4):
            broken[place] = rng.integers(0, 256)
        path.write_bytes(broken)
        try:
            load_mesh(path)
        except FileError:
            pass


def test_stl_merges_equal_places_alone(tmp_path):
    apart = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1e-9, 0, 0], [-0.0, 1, 0]])
    faces = np.array([[0, 1, 2], [3, 1, 4]], np.int32)
    save_mesh(tmp_path / "a.stl", TriangleMesh(apart.astype(np.float32), faces))
    mesh = load_mesh(tmp_path / "a.stl")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [3, 1, 2]])


def test_to_and_from_trimesh():
    peer = _peer()
    mesh = from_trimesh(peer)
    assert mesh.normals is None and mesh.vertices.dtype == np.float64
    colored = TriangleMesh(
        mesh.vertices,
        mesh.faces,
        np.asarray(peer.vertex_normals),
        {
            "colors": np.full(mesh.vertices.shape, 0.2, np.float32),
            "heat": np.arange(len(mesh.vertices)),
        },
    )
    back = from_trimesh(to_trimesh(colored))
    np.testing.assert_array_equal(back.vertices, colored.vertices)
    np.testing.assert_array_equal(back.faces, colored.faces)
    np.testing.assert_allclose(back.normals, colored.normals, atol=1e-12)
    np.testing.assert_array_equal(
        back.attributes["colors"], colored.attributes["colors"]
    )
    np.testing.assert_array_equal(back.attributes["heat"], colored.attributes["heat"])
    cloud = PointCloud(mesh.vertices, None, np.arange(len(mesh.vertices)) < 5)
    assert from_trimesh(to_trimesh(cloud)).points.shape == (5, 3)
    scene = trimesh.Scene([peer, trimesh.creation.box()])
    assert from_trimesh(scene).faces.shape[0] == len(peer.faces) + 12
    with pytest.raises(GeometryError, match="at least one mesh"):
        from_trimesh(trimesh.Scene())
    with pytest.raises(GeometryError, match="given: a str"):
        from_trimesh("mesh")


@pytest.mark.parametrize("scale", [(2, 3, 0.5), (-2, 3, 0.5)])
def test_scenes_are_placed(tmp_path, scale):
    ball = trimesh.creation.icosphere(subdivisions=2)
    unit = np.array(ball.vertices)
    ball = trimesh.Trimesh(unit, ball.faces, vertex_normals=unit, process=False)
    turn = trimesh.transformations.rotation_matrix(0.4, [3, 1, 2])
    turn[:3, :3] = turn[:3, :3] @ np.diag(scale)
    turn[:3, 3] = [5.0, 0.2, 0.3]
    scene = trimesh.Scene()
    scene.add_geometry(ball, transform=turn)
    scene.export(tmp_path / "a.glb")
    mesh = load_mesh(tmp_path / "a.glb")
    # The ellipsoid is where |A^-1 (y - t)| = 1; its normal is the gradient of that.
    inverse = np.linalg.inv(turn[:3, :3])
    local = (mesh.vertices - turn[:3, 3]) @ inverse.T
    np.testing.assert_allclose(np.linalg.norm(local, axis=1), 1, atol=1e-5)
    gradient = local @ inverse
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    np.testing.assert_allclose(mesh.normals, gradient, atol=1e-5)
    assert to_trimesh(mesh).volume > 0
    scene.add_geometry(trimesh.creation.box(extents=[1, 2, 3]))
    scene.export(tmp_path / "b.glb")
    joined = load_mesh(tmp_path / "b.glb")
    assert joined.normals is None
    np.testing.assert_allclose(
        to_trimesh(joined).volume, to_trimesh(mesh).volume + 6, rtol=1e-5
    )


def test_import_leaves_trimesh_alone():
    code = "import jaxgeom.io, sys; sys.exit('trimesh' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
