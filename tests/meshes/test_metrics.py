"""Metrics of clouds against scipy, point to mesh, evaluation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.spatial
import trimesh

from jaxgeom.meshes import (
    chamfer,
    evaluate,
    f_score,
    hausdorff,
    icosphere,
    normal_consistency,
    point_to_mesh,
)
from jaxgeom.shapes import PointCloud, TriangleMesh

from .shapes_for_tests import central_difference, padded


def two_clouds(n=90, m=70):
    keys = jax.random.split(jax.random.key(11), 4)
    scale = jnp.array([1.3, 0.6, 2.1])
    a = PointCloud(
        scale * jax.random.normal(keys[0], (n, 3)), jax.random.normal(keys[1], (n, 3))
    )
    b = PointCloud(
        scale * jax.random.normal(keys[2], (m, 3)) + 0.4,
        jax.random.normal(keys[3], (m, 3)),
    )
    return a, b


def padded_cloud(cloud, more=9):
    grow = lambda x: jnp.pad(x, ((0, more), (0, 0)), constant_values=jnp.nan)
    mask = jnp.arange(cloud.points.shape[0] + more) < cloud.points.shape[0]
    return PointCloud(grow(cloud.points), grow(cloud.normals), mask)


def test_agrees_with_scipy(x64):
    a, b = two_clouds()
    x, y = np.asarray(a.points), np.asarray(b.points)
    there, near = scipy.spatial.cKDTree(y).query(x)
    back, near_back = scipy.spatial.cKDTree(x).query(y)
    assert chamfer(a, b) == pytest.approx((there.mean() + back.mean()) / 2)
    assert chamfer(x, y) == pytest.approx(float(chamfer(a, b)))
    assert hausdorff(a, b) == pytest.approx(max(there.max(), back.max()))
    p, r = np.mean(there <= 0.5), np.mean(back <= 0.5)
    assert f_score(a, b, 0.5) == pytest.approx(2 * p * r / (p + r))
    unit = lambda v: np.asarray(v) / np.linalg.norm(v, axis=1, keepdims=True)
    u, w = unit(a.normals), unit(b.normals)
    cosine = np.abs(np.sum(u * w[near], axis=1)).mean()
    cosine_back = np.abs(np.sum(w * u[near_back], axis=1)).mean()
    assert normal_consistency(a, b) == pytest.approx((cosine + cosine_back) / 2)


METRICS = {
    "chamfer": chamfer,
    "hausdorff": hausdorff,
    "normal_consistency": normal_consistency,
    "f_score": lambda a, b: f_score(a, b, 0.5),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", METRICS)
def test_padding_changes_nothing(name):
    a, b = two_clouds()
    metric = METRICS[name]
    more = (padded_cloud(a), padded_cloud(b))
    assert metric(*more) == pytest.approx(float(metric(a, b)), rel=1e-6)
    if name == "chamfer":
        gradient = jax.grad(
            lambda x: metric(PointCloud(x, None, more[0].mask), more[1])
        )
        gradient = gradient(more[0].points)
        assert jnp.all(gradient[90:] == 0) and jnp.all(jnp.isfinite(gradient))
        assert jnp.any(gradient[:90] != 0)


@pytest.mark.parametrize("name", ["chamfer", "hausdorff", "normal_consistency"])
def test_gradients_are_central_differences(x64, name):
    a, b = two_clouds(40, 30)
    direction = jax.random.normal(jax.random.key(5), a.points.shape)

    def metric(x):
        return METRICS[name](PointCloud(a.points + x[0], a.normals + x[1]), b)

    x = jnp.zeros((2, *a.points.shape))
    way = jnp.stack([direction, -direction])
    numeric = central_difference(metric, x, way, step=1e-6)
    exact = jnp.vdot(jax.grad(metric)(x), way)
    assert exact == pytest.approx(float(numeric), rel=1e-6)


def test_a_cloud_is_at_distance_zero_from_itself():
    a, _ = two_clouds()
    assert chamfer(a, a) == hausdorff(a, a) == 0
    assert f_score(a, a, 0.0) == pytest.approx(1)
    assert normal_consistency(a, a) == pytest.approx(1)
    assert jnp.all(jax.grad(lambda x: chamfer(x, a.points))(a.points) == 0)


def test_empty_clouds():
    a, b = two_clouds()
    empty = PointCloud(b.points, b.normals, jnp.zeros(70, bool))
    assert chamfer(a, empty) == chamfer(empty, a) == jnp.inf
    assert hausdorff(a, empty) == jnp.inf
    assert f_score(a, empty, 0.5) == normal_consistency(a, empty) == 0
    assert chamfer(empty, empty) == 0


def test_normals_are_required():
    a, b = two_clouds()
    with pytest.raises(ValueError, match="needs normals on both clouds"):
        normal_consistency(a, PointCloud(b.points))


def test_vmap_is_loop():
    a, b = two_clouds(40, 40)
    x = jnp.stack([a.points, 2 * a.points])
    y = jnp.stack([b.points, b.points - 0.3])
    batched = jax.vmap(chamfer)(x, y)
    for i in range(2):
        assert batched[i] == pytest.approx(float(chamfer(x[i], y[i])), rel=1e-5)


def peer_distances(mesh, points):
    """The distances of points to a mesh: the smallest over all its triangles."""
    triangles = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    f, n = len(triangles), len(points)
    pairs = np.repeat(triangles, n, axis=0), np.tile(points, (f, 1))
    feet = trimesh.triangles.closest_point(*pairs)
    return np.linalg.norm(feet - pairs[1], axis=1).reshape(f, n).min(axis=0)


@pytest.mark.slow
def test_point_to_mesh_agrees_with_trimesh(x64):
    mesh = icosphere(1, radius=1.4)
    a, _ = two_clouds(60)
    distances = peer_distances(mesh, np.asarray(a.points))
    found = jax.jit(point_to_mesh)(a, mesh)
    np.testing.assert_allclose(found.distances, distances, atol=1e-10)
    assert found.rms == pytest.approx(np.sqrt(np.mean(distances**2)))
    assert found.mean == pytest.approx(np.mean(distances))
    assert found.max == pytest.approx(np.max(distances))
    more = point_to_mesh(padded_cloud(a), padded(mesh))
    assert more.rms == pytest.approx(float(found.rms))
    assert more.max == pytest.approx(float(found.max))
    nothing = TriangleMesh(mesh.vertices, mesh.faces, num_faces=jnp.int32(0))
    assert not jnp.any(point_to_mesh(a, nothing).mask)


def test_rms_of_a_point_on_the_surface_has_gradient_zero():
    mesh = icosphere(0)
    rms = lambda x: point_to_mesh(x, mesh).rms
    assert jnp.all(jax.grad(rms)(mesh.vertices[:3]) == 0)


@pytest.mark.slow
def test_evaluation_of_concentric_spheres():
    truth, found = icosphere(3), icosphere(3, radius=1.05)
    e = jax.jit(lambda a, b, k: evaluate(a, b, key=k, num=2000))(
        found, truth, jax.random.key(0)
    )
    # The faces of the two spheres are parallel, and 0.05 apart less the sagitta.
    assert e.rms_to_reference == pytest.approx(0.05, rel=0.02)
    assert e.rms_from_reference == pytest.approx(0.05, rel=0.02)
    assert e.rms == pytest.approx(0.05, rel=0.02)
    assert 0.049 <= e.hausdorff < 0.052
    assert e.chamfer == pytest.approx(float(e.accuracy + e.completeness) / 2, rel=1e-6)
    assert e.chamfer > e.rms
    assert e.f_score < 0.01
    assert e.normal_consistency > 0.97
