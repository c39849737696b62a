"""The files of JAXGEOM_DATA, with the counts that their sources publish."""

import gzip

import numpy as np
import pytest
import trimesh

from jaxgeom.io import FileError, load_cloud, load_mesh, save_mesh, to_trimesh

_CLOUDS = {
    "benchmark/anchor_scan.ply": (85_127, True),
    "benchmark/dc_scan.ply": (71_265, True),
    "benchmark/gargoyle_scan.ply": (95_435, True),
    "registration/fricp/source.ply": (14_806, True),
    "registration/fricp/target.ply": (15_446, True),
    "registration/pcl/bun0.pcd": (397, True),
    "registration/pcl/bun4.pcd": (361, False),
    "scans/distcap_scan.ply": (12_745, False),
    "scans/ipsr_woodfish.ply": (12_887, False),
    "scans/rangemap_lato000.ply": (44_269, True),
    "scans/rangemap_lato180.ply": (44_322, True),
    "scans/wnnc_armadillo_40000.ply": (40_000, False),
}
_MESHES = {
    "armadillo": (43_243, None),
    "bunny": (29_834, None),
    "falcon_open": (25_791, None),
    "fertility": (4_494, 4),
    "horse": (48_485, None),
    "nefertiti": (35_002, None),
}
_SCANS = (
    "bun000", "bun045", "bun090", "bun180", "bun270",
    "bun315", "chin", "ear_back", "top2", "top3",
)  # fmt: skip


@pytest.mark.parametrize("name", _CLOUDS)
def test_clouds(data, name):
    count, oriented = _CLOUDS[name]
    cloud = load_cloud(data / name)
    assert cloud.points.shape == (count, 3)
    assert (cloud.normals is not None) == oriented
    assert np.isfinite(cloud.points).all()
    with pytest.raises(FileError, match="must hold faces"):
        load_mesh(data / name)


@pytest.mark.parametrize("name", _SCANS)
def test_stanford_scans(data, name):
    folder = data / "registration" / "stanford_bunny"
    cloud = load_cloud(folder / f"{name}.ply.gz")
    want = np.load(folder / "bunny_scans.npz")[f"{name}_xyz"]
    np.testing.assert_array_equal(cloud.points.astype(np.float32), want)


def test_stanford_reconstruction(data):
    folder = data / "registration" / "stanford_bunny"
    mesh = load_mesh(folder / "bun_zipper_res2.ply.gz")
    assert mesh.vertices.shape == (8171, 3) and mesh.faces.shape == (16301, 3)
    assert set(mesh.attributes) == {"confidence", "intensity"}
    with pytest.raises(FileError, match="bun000_xyz"):
        load_cloud(folder / "bunny_scans.npz")


def test_small_gicp(data):
    folder = data / "registration" / "small_gicp"
    counts = set()
    for name in ("source", "target"):
        cloud = load_cloud(folder / f"{name}.ply")
        counts.add(cloud.points.shape[0])
        intensity = cloud.attributes["scalar_intensity"]
        assert intensity.dtype == np.float32 and np.isfinite(intensity).all()
    assert counts == {69_088, 69_792}


@pytest.mark.parametrize("number", range(1, 7))
def test_teaser(data, number):
    folder = data / "registration" / "teaser" / f"benchmark_{number}"
    source, target = (load_cloud(folder / f"{n}.ply") for n in ("src", "dst"))
    assert source.points.shape == target.points.shape
    # The text has 15 digits, though its header says float32.
    assert source.points.dtype == np.float64


@pytest.mark.parametrize("name", _MESHES)
def test_meshes(data, name, tmp_path):
    count, genus = _MESHES[name]
    mesh = load_mesh(data / "meshes" / f"{name}.ply")
    assert mesh.vertices.shape == (count, 3)
    peer = trimesh.load_mesh(data / "meshes" / f"{name}.ply", process=False)
    np.testing.assert_array_equal(mesh.vertices, peer.vertices)
    np.testing.assert_array_equal(mesh.faces, peer.faces)
    own = to_trimesh(mesh)
    assert own.is_watertight == (name != "falcon_open")
    if genus is not None:
        assert own.euler_number == 2 - 2 * genus
    np.testing.assert_array_equal(
        load_cloud(data / "meshes" / f"{name}.ply").points, mesh.vertices
    )


@pytest.mark.parametrize("form", ["ply", "obj", "off", "stl", "glb"])
def test_a_real_mesh_through_every_format(data, tmp_path, form):
    mesh = load_mesh(data / "meshes" / "fertility.ply")
    save_mesh(tmp_path / f"a.{form}", mesh)
    back = load_mesh(tmp_path / f"a.{form}")
    assert back.vertices.shape == (4494, 3) and back.faces.shape == (9000, 3)
    np.testing.assert_array_equal(
        back.vertices[back.faces].astype(np.float32), mesh.vertices[mesh.faces]
    )


@pytest.mark.parametrize("name, genus", [("anchor_gt", 4), ("dc_gt", 8)])
def test_benchmark_meshes(data, name, genus):
    own = to_trimesh(load_mesh(data / "benchmark" / f"{name}.ply"))
    assert own.is_watertight and own.euler_number == 2 - 2 * genus


@pytest.mark.parametrize(
    "name",
    [
        "registration/pcl/bun0.pcd",
        "registration/fricp/target.ply",
        "meshes/fertility.ply",
        "registration/stanford_bunny/top3.ply.gz",
    ],
)
def test_cut_real_files(data, tmp_path, name):
    whole = (data / name).read_bytes()
    path = tmp_path / name.rsplit("/", 1)[1]
    for part in np.linspace(0, 0.99, 12):
        path.write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(FileError):
            load_cloud(path)
    if name.endswith(".gz"):
        plain = gzip.decompress(whole)
        path.write_bytes(plain[: len(plain) // 2])
        with pytest.raises(FileError, match="promises"):
            load_cloud(path)
