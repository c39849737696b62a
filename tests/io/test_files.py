"""Paths, mislabelled files, numpy files, and the errors of all of them."""

import gzip
import os
import shutil

import numpy as np
import pytest

from jaxgeom import GeometryError
from jaxgeom.io import FileError, load_cloud, load_mesh, save_cloud, save_mesh
from jaxgeom.io._files import CLOUD_FORMATS, MESH_FORMATS
from jaxgeom.shapes import PointCloud, TriangleMesh

_POINTS = np.random.default_rng(0).normal(size=(9, 3))
_CLOUD = PointCloud(_POINTS)
_MESH = TriangleMesh(_POINTS.astype(np.float32), np.arange(9).reshape(3, 3))


def _fails(function, *args, says):
    with pytest.raises(FileError, match=says) as error:
        function(*args)
    assert isinstance(error.value, GeometryError)
    assert "; given: " in str(error.value)


@pytest.mark.parametrize("load", [load_cloud, load_mesh])
def test_paths_that_cannot_be_read(tmp_path, load):
    _fails(load, tmp_path / "none.ply", says="none.ply .*No such file")
    _fails(load, tmp_path, says="irectory")
    _fails(load, "a\0b.ply", says="readable")
    (tmp_path / "empty.ply").touch()
    _fails(load, tmp_path / "empty.ply", says="0 bytes")
    (tmp_path / "empty.ply.gz").write_bytes(gzip.compress(b""))
    _fails(load, tmp_path / "empty.ply.gz", says="0 bytes")
    (tmp_path / "scan.e57").write_text("ASTM-E57")
    _fails(load, tmp_path / "scan.e57", says="formats ply, pcd, .* extension .e57")
    (tmp_path / "scan").write_text("hello")
    _fails(load, tmp_path / "scan", says="no extension")


@pytest.mark.parametrize("form", ["ply", "pcd", "npy", "npz"])
@pytest.mark.parametrize("label", ["a", "a.dat", "a.xyz", "a.stl", "a.ply.gz"])
def test_clear_contents_go_before_the_extension(tmp_path, form, label):
    save_cloud(tmp_path / f"a.{form}", _CLOUD)
    shutil.move(tmp_path / f"a.{form}", tmp_path / label)
    np.testing.assert_array_equal(load_cloud(tmp_path / label).points, _POINTS)


@pytest.mark.parametrize("form", ["ply", "stl", "off", "glb"])
def test_mislabelled_meshes(tmp_path, form):
    save_mesh(tmp_path / f"a.{form}", _MESH)
    shutil.move(tmp_path / f"a.{form}", tmp_path / "a.dat")
    mesh = load_mesh(tmp_path / "a.dat")
    np.testing.assert_array_equal(
        mesh.vertices[mesh.faces].astype(np.float32), _MESH.vertices[_MESH.faces]
    )


def test_a_wrong_extension_without_clear_contents_is_reported(tmp_path):
    (tmp_path / "a.ply").write_text("1 2 3\n")
    _fails(load_cloud, tmp_path / "a.ply", says="does not start with a line 'ply'")
    (tmp_path / "a.pcd").write_text("1 2 3\n")
    _fails(load_cloud, tmp_path / "a.pcd", says="no line 'DATA'")
    (tmp_path / "a.off").write_text("1 2 3\n")
    _fails(load_cloud, tmp_path / "a.off", says="OFF")
    (tmp_path / "a.xyz").write_text("1 2 3\n")
    _fails(load_mesh, tmp_path / "a.xyz", says="must hold faces")


@pytest.mark.parametrize("save, shape", [(save_cloud, _CLOUD), (save_mesh, _MESH)])
def test_paths_that_cannot_be_written(tmp_path, save, shape):
    _fails(save, tmp_path / "none" / "a.ply", shape, says="a.ply must be writable")
    (tmp_path / "folder.ply").mkdir()
    _fails(save, tmp_path / "folder.ply", shape, says="folder")
    _fails(save, tmp_path / "a.doc", shape, says="extension .doc")
    _fails(save, tmp_path / "a", shape, says="no extension")
    assert sorted(os.listdir(tmp_path)) == ["folder.ply"]


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    save_cloud(path, _CLOUD)
    before = path.read_bytes()

    def broken(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", broken)
    _fails(save_cloud, path, PointCloud(_POINTS + 1), says="No space left")
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.ply"]


def test_saving_through_a_link_keeps_the_link(tmp_path):
    (tmp_path / "real.ply").touch()
    (tmp_path / "link.ply").symlink_to(tmp_path / "real.ply")
    save_cloud(tmp_path / "link.ply", _CLOUD)
    assert (tmp_path / "link.ply").is_symlink()
    assert load_cloud(tmp_path / "real.ply").points.shape == (9, 3)


@pytest.mark.parametrize("form", CLOUD_FORMATS)
def test_clouds_that_no_file_can_hold(tmp_path, form):
    path = tmp_path / f"a.{form}"
    bad = [
        PointCloud(np.zeros((0, 3))),
        PointCloud(_POINTS, None, np.zeros(9, bool)),
        PointCloud(_POINTS, None, None, {"x": np.zeros(9)}),
        PointCloud(_POINTS, None, None, {"normal_x": np.zeros(9)}),
        PointCloud(_POINTS, None, None, {"a b": np.zeros(9), "a_b": np.zeros(9)}),
        PointCloud(_POINTS, None, None, {"z": np.array(["a"] * 9)}),
        PointCloud(_POINTS, None, None, {"c": np.zeros(9, complex)}),
    ]
    for cloud in bad:
        with pytest.raises(GeometryError):
            save_cloud(path, cloud)
    batch = PointCloud(_POINTS)
    object.__setattr__(batch, "points", np.zeros((2, 9, 3)))
    with pytest.raises(GeometryError, match="batch of shape"):
        save_cloud(path, batch)
    assert not path.exists()


@pytest.mark.parametrize("form", MESH_FORMATS)
def test_files_that_are_cut_in_compression(tmp_path, form):
    save_mesh(tmp_path / f"a.{form}.gz", _MESH)
    data = (tmp_path / f"a.{form}.gz").read_bytes()
    for cut in range(2, len(data), 9):
        (tmp_path / f"a.{form}.gz").write_bytes(data[:cut])
        with pytest.raises(FileError):
            load_mesh(tmp_path / f"a.{form}.gz")


@pytest.mark.parametrize("form", ["npy", "npz"])
def test_cut_and_broken_numpy_files(tmp_path, form):
    path = tmp_path / f"a.{form}"
    save_cloud(path, PointCloud(_POINTS, _POINTS, None, {"q": np.arange(9)}))
    data = path.read_bytes()
    for cut in [*range(0, 150, 2), *range(150, len(data), 17), len(data) - 1]:
        path.write_bytes(data[:cut])
        with pytest.raises(FileError):
            load_cloud(path)
    rng = np.random.default_rng(0)
    for _ in range(150):
        broken = bytearray(data)
        for place in rng.integers(0, len(data), 3):
            broken[place] = rng.integers(0, 256)
        path.write_bytes(broken)
        try:
            load_cloud(path)
        except FileError:
            pass


def test_numpy_arrays_of_other_programs(tmp_path):
    normals = _POINTS / np.linalg.norm(_POINTS, axis=1, keepdims=True)
    np.save(tmp_path / "a.npy", np.hstack([_POINTS, normals]).astype(">f4"))
    cloud = load_cloud(tmp_path / "a.npy")
    assert cloud.points.dtype == np.float32
    np.testing.assert_array_equal(cloud.points, _POINTS.astype(np.float32))
    np.testing.assert_array_equal(cloud.normals, normals.astype(np.float32))
    np.save(tmp_path / "i.npy", np.array([[4_000_001, 2, 3]], np.int64))
    np.testing.assert_array_equal(load_cloud(tmp_path / "i.npy").points[0, 0], 4000001)
    np.savez(tmp_path / "a.npz", scan=_POINTS, other=np.zeros(4))
    np.testing.assert_array_equal(load_cloud(tmp_path / "a.npz").points, _POINTS)
    np.savez(
        tmp_path / "b.npz", xyz=_POINTS, rgb=np.full((9, 3), 51, np.uint8), t=np.ones(9)
    )
    cloud = load_cloud(tmp_path / "b.npz")
    np.testing.assert_allclose(cloud.attributes["colors"], 0.2)
    np.testing.assert_array_equal(cloud.attributes["t"], np.ones(9))


def test_numpy_files_without_points(tmp_path):
    np.savez(tmp_path / "a.npz", left=_POINTS, right=_POINTS)
    _fails(load_cloud, tmp_path / "a.npz", says=r"left \(9, 3\), right \(9, 3\)")
    np.savez(tmp_path / "a.npz", values=np.zeros(5))
    _fails(load_cloud, tmp_path / "a.npz", says="values")
    np.savez(tmp_path / "a.npz", points=np.array([{"a": 1}], object))
    _fails(load_cloud, tmp_path / "a.npz", says="pickle")
    for bad in (np.zeros(5), np.zeros((2, 2)), np.zeros((3, 3), complex)):
        np.save(tmp_path / "a.npy", bad)
        _fails(load_cloud, tmp_path / "a.npy", says="a.npy")
    np.savez(tmp_path / "a.npz", vertices=_POINTS, faces=np.zeros((2, 4), int))
    _fails(load_mesh, tmp_path / "a.npz", says=r"faces of shape \(2, 4\)")
    cloud = PointCloud(_POINTS, None, None, {"faces": np.zeros(9)})
    with pytest.raises(GeometryError, match="'faces'"):
        save_cloud(tmp_path / "b.npz", cloud)
