"""What is written is read back: positions, normals, colors, attributes, faces."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxgeom.io import load_cloud, load_mesh, save_cloud, save_mesh, to_trimesh
from jaxgeom.io._files import CLOUD_FORMATS, MESH_FORMATS
from jaxgeom.shapes import PointCloud, TriangleMesh

_EXACT = ("ply", "pcd", "npy", "npz")
_FAR = np.array([4_123_456.7, -3_987_654.3, 512.9])


def _cloud(dtype=np.float64, offset=0.0, n=37):
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors = rng.integers(0, 256, (n, 3)).astype(np.uint8)
    return PointCloud(
        (rng.normal(size=(n, 3)) * [3, 0.02, 1] + offset).astype(dtype),
        normals.astype(dtype),
        None,
        {
            "colors": (colors / 255).astype(np.float32),
            "label": rng.integers(-1000, 1000, n).astype(np.int32),
            "intensity": rng.random(n),
        },
    )


def _mesh(dtype=np.float64, offset=0.0):
    ball = trimesh.creation.icosphere(subdivisions=1, radius=1.7)
    points = np.asarray(ball.vertices) * [1, 2, 0.3]
    colors = np.random.default_rng(1).integers(0, 256, points.shape) / 255
    return TriangleMesh(
        (points + offset).astype(dtype),
        np.asarray(ball.faces, np.int32),
        np.asarray(ball.vertices / 1.7, dtype),
        {"colors": colors.astype(np.float32)},
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("form", [*CLOUD_FORMATS, "ply.gz", "csv.gz"])
def test_cloud_roundtrip(tmp_path, form, dtype):
    cloud = _cloud(dtype)
    path = tmp_path / f"cloud.{form}"
    save_cloud(path, cloud)
    back = load_cloud(path)
    text = form.split(".")[0] not in _EXACT
    assert back.points.dtype == (np.float64 if text else dtype)
    np.testing.assert_array_equal(back.points.astype(dtype), cloud.points)
    np.testing.assert_array_equal(back.normals.astype(dtype), cloud.normals)
    assert back.mask.all() and back.mask.shape == (37,)
    assert set(back.attributes) == set(cloud.attributes)
    colors = back.attributes["colors"]
    assert colors.dtype == np.float32 and colors.shape == (37, 3)
    np.testing.assert_array_equal(colors, cloud.attributes["colors"])
    for name in ("label", "intensity"):
        np.testing.assert_array_equal(back.attributes[name], cloud.attributes[name])


@pytest.mark.parametrize("form", CLOUD_FORMATS)
def test_far_coordinates_keep_their_details(tmp_path, form):
    rng = np.random.default_rng(0)
    details = rng.normal(size=(50, 3)) * 1e-4
    path = tmp_path / f"far.{form}"
    save_cloud(path, PointCloud(details + _FAR))
    back = load_cloud(path)
    assert back.points.dtype == np.float64
    np.testing.assert_array_equal(back.points, details + _FAR)


def test_only_real_points_are_saved(tmp_path):
    cloud = _cloud()
    mask = np.arange(37) % 3 == 0
    padded = PointCloud(cloud.points, cloud.normals, mask, cloud.attributes)
    save_cloud(tmp_path / "c.ply", padded)
    np.testing.assert_array_equal(
        load_cloud(tmp_path / "c.ply").points, cloud.points[mask]
    )


def test_npz_keeps_the_shapes_of_attributes(tmp_path):
    features = np.arange(5 * 2 * 3, dtype=np.float32).reshape(5, 2, 3)
    points = np.random.default_rng(0).random((5, 3))
    cloud = PointCloud(points, None, None, {"features": features})
    save_cloud(tmp_path / "c.npz", cloud)
    back = load_cloud(tmp_path / "c.npz").attributes["features"]
    np.testing.assert_array_equal(back, features)
    save_cloud(tmp_path / "c.ply", cloud)
    columns = load_cloud(tmp_path / "c.ply").attributes
    np.testing.assert_array_equal(columns["features_4"], features.reshape(5, 6)[:, 4])


@pytest.mark.parametrize("kind", [jnp.float32, jnp.bfloat16, jnp.float16])
def test_jax_arrays_are_saved(tmp_path, kind):
    points = jnp.arange(12, dtype=kind).reshape(4, 3) / 7
    save_cloud(tmp_path / "c.ply", PointCloud(points))
    back = load_cloud(tmp_path / "c.ply").points
    assert back.dtype == np.float32
    np.testing.assert_array_equal(back, np.asarray(points).astype(np.float32))


@pytest.mark.parametrize(
    "dtype",
    [np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.int64, bool],
)
@pytest.mark.parametrize("form", CLOUD_FORMATS)
def test_integer_attributes(tmp_path, form, dtype):
    values = np.array([0, 1, 1, 0, 1]).astype(dtype)
    points = np.random.default_rng(5).normal(size=(5, 3))
    save_cloud(tmp_path / f"c.{form}", PointCloud(points, None, None, {"id": values}))
    back = load_cloud(tmp_path / f"c.{form}").attributes["id"]
    np.testing.assert_array_equal(back, values)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("form", [*MESH_FORMATS, "obj.gz", "ply.gz"])
def test_mesh_roundtrip(tmp_path, form, dtype):
    mesh = _mesh(dtype)
    path = tmp_path / f"mesh.{form}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        save_mesh(path, mesh)
    back = load_mesh(path)
    form = form.split(".")[0]
    tight = dtype if form not in ("stl", "glb") else np.float32
    want = mesh.vertices[mesh.faces].astype(tight)
    np.testing.assert_array_equal(back.vertices[back.faces].astype(tight), want)
    assert back.faces.dtype == np.int32
    if form != "stl":
        np.testing.assert_array_equal(back.faces, mesh.faces)
    if form not in ("off", "stl"):
        np.testing.assert_allclose(back.normals, mesh.normals, atol=2e-7)
        colors = back.attributes["colors"]
        np.testing.assert_array_equal(colors, mesh.attributes["colors"])
    assert to_trimesh(back).is_watertight
    cloud = load_cloud(path)
    np.testing.assert_array_equal(cloud.points, back.vertices)
    assert (cloud.normals is None) == (back.normals is None)


@pytest.mark.parametrize("form", ["ply", "obj", "off", "npz"])
def test_far_meshes_keep_their_details(tmp_path, form):
    mesh = _mesh(offset=_FAR)
    mesh = TriangleMesh(mesh.vertices * 1e-4 + _FAR, mesh.faces)
    save_mesh(tmp_path / f"m.{form}", mesh)
    back = load_mesh(tmp_path / f"m.{form}")
    np.testing.assert_array_equal(back.vertices, mesh.vertices)


@pytest.mark.parametrize("form", ["stl", "glb"])
def test_single_precision_formats_warn_of_loss(tmp_path, form):
    near, far = _mesh(), _mesh(offset=_FAR)
    plain = lambda mesh: TriangleMesh(mesh.vertices, mesh.faces)
    with pytest.warns(UserWarning, match="float32"):
        save_mesh(tmp_path / f"m.{form}", plain(far))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        save_mesh(tmp_path / f"m.{form}", plain(near))


@pytest.mark.parametrize("form", ["stl", "off"])
def test_what_a_format_cannot_hold_is_named(tmp_path, form):
    with pytest.warns(UserWarning, match="do not hold nx, ny, nz, red"):
        save_mesh(tmp_path / f"m.{form}", _mesh())


def test_padding_of_a_mesh_is_not_saved(tmp_path):
    mesh = _mesh()
    v, f = mesh.vertices.shape[0], mesh.faces.shape[0]
    padded = TriangleMesh(
        np.pad(mesh.vertices, [(0, 9), (0, 0)]),
        np.pad(mesh.faces, [(0, 5), (0, 0)], constant_values=v + 9),
        num_vertices=np.int32(v),
        num_faces=np.int32(f),
    )
    save_mesh(tmp_path / "m.ply", padded)
    back = load_mesh(tmp_path / "m.ply")
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.faces, mesh.faces)


def test_equal_clouds_give_equal_files(tmp_path):
    for form in ("ply", "ply.gz", "pcd", "csv"):
        for name in ("a", "b"):
            save_cloud(tmp_path / f"{name}.{form}", _cloud())
        a, b = ((tmp_path / f"{name}.{form}").read_bytes() for name in ("a", "b"))
        assert a == b
