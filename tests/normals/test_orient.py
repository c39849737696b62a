"""Signs of normals: by viewpoint, and without one on closed surfaces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxgeom._core import GeometryError
from jaxgeom.normals import (
    estimate,
    orient_consistently,
    orient_toward_viewpoint,
)
from jaxgeom.shapes import PointCloud


def _sampled(mesh, n, seed):
    points, faces = trimesh.sample.sample_surface(mesh, n, seed=seed)
    return points.astype(np.float32), mesh.face_normals[faces]


def _share_outward(normals, truth):
    return float(np.mean((np.asarray(normals) * truth).sum(axis=1) > 0))


def test_viewpoints():
    sphere = trimesh.creation.icosphere(subdivisions=4)
    points, truth = _sampled(sphere, 800, 0)
    cloud = estimate(PointCloud(points + np.float32([3, 0, 1])))
    inside = orient_toward_viewpoint(cloud, jnp.asarray([3.0, 0, 1]))
    assert _share_outward(inside.normals, truth) == 0
    outside = orient_toward_viewpoint(cloud, cloud.points + 2 * truth)
    assert _share_outward(outside.normals, truth) == 1
    with pytest.raises(GeometryError, match="must have normals"):
        orient_toward_viewpoint(PointCloud(points), jnp.zeros(3))


@pytest.mark.slow
def test_two_objects_and_a_hollow_one():
    big = trimesh.creation.icosphere(subdivisions=4, radius=1.3)
    hollow = trimesh.creation.icosphere(subdivisions=4, radius=0.7)
    hollow.invert()
    ring = trimesh.creation.torus(1.5, 0.5).apply_translation([4, 1, 0])
    mesh = trimesh.util.concatenate([big, hollow, ring])
    points, truth = _sampled(mesh, 2500, 1)
    mask = np.arange(2800) < 2500
    padded = np.concatenate([points, np.full((300, 3), np.nan, np.float32)])
    run = jax.jit(lambda c: orient_consistently(c, capacity=1500))
    out = run(PointCloud(padded, mask=mask))
    outer = np.linalg.norm(points, axis=1) > 1
    assert _share_outward(out.normals[:2500][outer], truth[outer]) > 0.99
    assert (out.normals[2500:] == 0).all()


@pytest.mark.slow
def test_given_normals_only_change_sign():
    points, truth = _sampled(trimesh.creation.torus(1.5, 0.5), 1500, 2)
    flips = np.where(np.random.default_rng(0).random(1500) < 0.5, -3, 3)[:, None]
    out = orient_consistently(PointCloud(points, truth * flips), capacity=1000)
    np.testing.assert_allclose(out.normals, 3 * truth, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["armadillo", "horse"])
def test_real_shapes(data, name):
    mesh = trimesh.load(data / "meshes" / f"{name}.ply", process=False)
    points, truth = _sampled(mesh, 10_000, 0)
    out = jax.jit(lambda c: orient_consistently(c, capacity=2048))(PointCloud(points))
    assert _share_outward(out.normals, truth) > 0.97


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("name", ["armadillo", "horse"])
def test_real_shapes_large(data, name, seed):
    mesh = trimesh.load(data / "meshes" / f"{name}.ply", process=False)
    points, truth = _sampled(mesh, 50_000, seed)
    out = jax.jit(orient_consistently)(PointCloud(points))
    assert _share_outward(out.normals, truth) > 0.99
