"""Pictures: silhouettes agree between renderers, files are what they should be."""

import io
import os
import struct
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import fields as jf
from jaxgeom import render
from jaxgeom.render import _visibility as visibility
from jaxgeom.shapes import PointCloud, TriangleMesh

trimesh = pytest.importorskip("trimesh")

CAMERA = render.Camera((1.4, -3.1, 1.2), (0.1, 0.0, 0.05), (0.0, 0.0, 1.0), 33.0)
SIZE = (60, 84)
RED = (0.9, 0.1, 0.1)


def torus_mesh(sections=96):
    body = trimesh.creation.torus(
        0.6, 0.25, major_sections=2 * sections, minor_sections=sections
    )
    vertices = np.asarray(body.vertices, np.float32)
    return TriangleMesh(vertices, np.asarray(body.faces))


def is_red(image):
    image = image.astype(int)
    return image[..., 0] > image[..., 2]


@pytest.mark.slow
def test_field_and_mesh_of_one_body_give_one_picture():
    field = render.render_field(jf.Torus(0.6, 0.25), CAMERA, size=SIZE, color=RED)
    mesh = render.render_mesh(torus_mesh(), CAMERA, size=SIZE, color=RED)
    assert field.dtype == mesh.dtype == np.uint8 and field.shape == (*SIZE, 3)
    assert 0.1 < is_red(field).mean() < 0.6
    assert (is_red(field) != is_red(mesh)).mean() < 0.004
    assert np.abs(field.astype(int) - mesh).mean() < 1


def test_the_silhouette_is_where_the_rays_hit():
    image = render.render_field(jf.Sphere(0.7), CAMERA, size=SIZE, color=RED, samples=1)
    rays = CAMERA.directions(SIZE)
    eye = CAMERA.position
    along = -jnp.sum(rays * eye, axis=-1)
    miss = jnp.sqrt(jnp.sum(eye**2) - along**2)
    sure = np.abs(miss - 0.7) > 0.01
    np.testing.assert_array_equal(is_red(image)[sure], np.asarray(miss < 0.7)[sure])


def test_raster_and_rays_see_the_same_faces():
    pytest.importorskip("embreex")
    mesh = torus_mesh(40)
    arrays = mesh.vertices, mesh.faces
    by_rays = visibility.by_rays(*arrays, CAMERA, SIZE)
    by_raster = visibility.by_raster(*arrays, CAMERA, SIZE)
    assert by_raster.min() >= 0 and by_raster.max() == len(mesh.faces)
    assert (by_rays != by_raster).mean() < 0.005


def test_raster_keeps_the_nearest_of_large_overlapping_faces():
    corners = np.array([[-9, 0, -9], [9, 0, -9], [0, 0, 30.0]], np.float32)
    layers = np.concatenate([corners + [0, y, 0] for y in (1, -0.5, 0.3)])
    faces = np.arange(9).reshape(3, 3)
    camera = render.Camera((0.0, -4.0, 0.0))
    seen = visibility.by_raster(layers, faces, camera, (20, 30))
    assert (seen == 1).all()


def test_faces_behind_the_eye_and_empty_meshes_are_not_seen():
    mesh = torus_mesh(8)
    away = render.Camera((0.0, -4.0, 0.0), (0.0, -8.0, 0.0))
    seen = visibility.by_raster(mesh.vertices, mesh.faces, away, SIZE)
    assert (seen == len(mesh.faces)).all()
    empty = TriangleMesh(np.zeros((1, 3), np.float32), np.zeros((0, 3), np.int32))
    picture = render.render_mesh(empty, CAMERA, size=SIZE, color=RED)
    assert not is_red(picture).any()


def test_padding_of_a_mesh_does_not_show():
    mesh = torus_mesh(12)
    v, f = len(mesh.vertices), len(mesh.faces)
    padded = TriangleMesh(
        np.pad(mesh.vertices, [(0, 5), (0, 0)]),
        np.concatenate([mesh.faces, np.full((7, 3), v + 5)]),
        num_vertices=np.int32(v),
        num_faces=np.int32(f),
    )
    pictures = [render.render_mesh(m, CAMERA, size=SIZE) for m in (mesh, padded)]
    np.testing.assert_array_equal(*pictures)


def test_colors_of_vertices_are_shown():
    mesh = torus_mesh(16)
    paint = np.tile(np.float32(RED), (len(mesh.vertices), 1))
    painted = TriangleMesh(mesh.vertices, mesh.faces, attributes={"colors": paint})
    np.testing.assert_array_equal(
        render.render_mesh(painted, CAMERA, size=SIZE),
        render.render_mesh(mesh, CAMERA, size=SIZE, color=RED),
    )


@pytest.mark.parametrize("with_normals", [True, False])
def test_a_dense_cloud_covers_the_silhouette(with_normals):
    mesh = torus_mesh()
    field = jf.Torus(0.6, 0.25)
    normals = jax.vmap(lambda p: jf.normal(field, p))(jnp.asarray(mesh.vertices))
    cloud = PointCloud(mesh.vertices, normals if with_normals else None)
    dots = render.render_cloud(cloud, CAMERA, size=SIZE, radius=0.03, color=RED)
    body = render.render_field(jf.Torus(0.6, 0.28), CAMERA, size=SIZE, color=RED)
    assert (is_red(dots) != is_red(body)).mean() < 0.01


def test_masked_points_are_not_drawn_and_the_nearest_covers():
    points = np.array([[0, 0, 0], [0, -1, 0], [0, -2, 0]], np.float32)
    colors = np.array([[0.1, 0.1, 0.9], RED, [0.1, 0.9, 0.1]], np.float32)
    mask = np.array([True, True, False])
    cloud = PointCloud(points, None, mask, {"colors": colors})
    camera = render.Camera((0.0, -5.0, 0.0))
    image = render.render_cloud(cloud, camera, size=(21, 21), radius=0.3)
    assert is_red(image)[10, 10] and image[..., 1].max() < 250


def test_png_can_be_read_back(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (13, 29, 3)).astype(np.uint8)
    path = render.save_png(tmp_path / "noise.png", image)
    assert os.listdir(tmp_path) == ["noise.png"]
    np.testing.assert_array_equal(decode(path.read_bytes()), image)
    pillow = pytest.importorskip("PIL.Image")
    read = np.asarray(pillow.open(io.BytesIO(path.read_bytes())))
    np.testing.assert_array_equal(read, image)


def decode(data):
    """A PNG with filter 2 as this package writes it; checks every checksum."""
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = {}, 8
    while at < len(data):
        (length,) = struct.unpack(">I", data[at : at + 4])
        body = data[at + 4 : at + 8 + length]
        (check,) = struct.unpack(">I", data[at + 8 + length : at + 12 + length])
        assert check == zlib.crc32(body)
        chunks[body[:4]] = body[4:]
        at += 12 + length
    width, height = struct.unpack(">II", chunks[b"IHDR"][:8])
    lines = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8)
    lines = lines.reshape(height, 1 + 3 * width)
    assert (lines[:, 0] == 2).all()
    rows = np.cumsum(lines[:, 1:], axis=0, dtype=np.uint8)
    return rows.reshape(height, width, 3)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    image = np.zeros((2, 3, 3), np.uint8)
    path = render.save_png(tmp_path / "a.png", image)
    before = path.read_bytes()

    def refuse(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(OSError, match="disk full"):
        render.save_png(path, image + 9)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["a.png"]


def test_wrong_pictures_are_errors(tmp_path):
    with pytest.raises(ValueError, match="picture must be uint8"):
        render.save_png(tmp_path / "a.png", np.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match="needs a picture"):
        render.side_by_side([])


def test_side_by_side_keeps_every_picture():
    tall, wide = np.full((6, 2, 3), 10, np.uint8), np.full((4, 5, 3), 20, np.uint8)
    row = render.side_by_side([tall, wide], gap=3)
    assert row.shape == (6, 10, 3)
    assert (row[:, :2] == 10).all() and (row[1:5, 5:] == 20).all()


def test_html_holds_everything(tmp_path):
    path = render.save_html(tmp_path / "torus.html", torus_mesh(8))
    page = path.read_text()
    assert "<script" in page and 'src="http' not in page and 'href="http' not in page
    assert "import(" not in page and len(page) > 500_000
