"""The batched door of reconstruction: each scan as alone, a bad one alone in it."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from jaxgeom import RESULTS, PointCloud, stack
from jaxgeom._core import GeometryError
from jaxgeom.meshes import topology
from jaxgeom.pipelines import reconstruct, reconstruct_many

RESOLUTION = 24


def _scan(n, seed, center=(0.0, 0.0, 0.0), size=1.0):
    """Points of an ellipsoid, and its normals."""
    axes = np.array([1.0, 0.8, 0.6])
    x = np.random.default_rng(seed).normal(size=(n, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    normals = x / axes
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(size * axes * x + np.array(center), normals)


def _batch():
    spoiled = _scan(300, 3)
    points = np.array(spoiled.points)
    points[::7] = np.nan
    return [
        _scan(320, 1, (5.0, -2.0, 1.0), 3.0),
        _scan(2, 2),
        PointCloud(points, spoiled.normals),
        PointCloud(np.ones((9, 3)), np.ones((9, 3))),
        _scan(200, 4, size=0.1),
    ]


def _float(cloud):
    return PointCloud(
        *(np.asarray(x, np.float32) for x in (cloud.points, cloud.normals))
    )


def test_each_is_as_alone_and_bad_scans_spoil_nothing():
    scans = [_float(scan) for scan in _batch()]
    found = reconstruct_many(stack(scans), resolution=RESOLUTION)
    wrong = {1: RESULTS.too_few_points, 3: RESULTS.degenerate_input}
    for i, (scan, item) in enumerate(zip(scans, found, strict=True)):
        assert item.result == wrong.get(i, RESULTS.successful), i
        if i in wrong:
            assert len(item.mesh.faces) == 0
            continue
        there = np.isfinite(scan.points).all(axis=1)
        clean = PointCloud(scan.points[there], scan.normals[there])
        alone = reconstruct(clean, resolution=RESOLUTION)
        np.testing.assert_array_equal(item.mesh.faces, alone.mesh.faces)
        size = np.ptp(clean.points)
        np.testing.assert_allclose(
            item.mesh.vertices, alone.mesh.vertices, atol=2e-4 * size
        )
        assert bool(topology(jax.tree.map(jax.numpy.asarray, item.mesh)).is_closed)


def test_order_does_not_matter():
    scans = [_float(scan) for scan in _batch()]
    forth = reconstruct_many(stack(scans), resolution=RESOLUTION)
    back = reconstruct_many(stack(scans[::-1]), resolution=RESOLUTION)[::-1]
    for one, other in zip(forth, back, strict=True):
        assert one.result == other.result
        np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)
        np.testing.assert_array_equal(one.mesh.faces, other.mesh.faces)


def test_one_cloud_is_no_batch():
    with pytest.raises(GeometryError, match="must be a batch"):
        reconstruct_many(_float(_scan(50, 1)), resolution=RESOLUTION)


@pytest.mark.slow
def test_four_devices_equal_one(tmp_path):
    code = f"""
import sys; sys.path.insert(0, {os.path.dirname(__file__)!r})
import jax, numpy as np
from test_reconstruct_many import _batch, _float
from jaxgeom import reconstruct_many, stack
found = reconstruct_many(stack([_float(s) for s in _batch()]), resolution=24)
np.savez(sys.argv[1], n=jax.local_device_count(),
         **{{f"v{{i}}": item.mesh.vertices for i, item in enumerate(found)}},
         **{{f"f{{i}}": item.mesh.faces for i, item in enumerate(found)}})
"""
    tables = []
    for count in (1, 4):
        flags = f"--xla_force_host_platform_device_count={count}"
        path = tmp_path / f"{count}.npz"
        env = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
        subprocess.run([sys.executable, "-c", code, str(path)], check=True, env=env)
        tables.append(np.load(path))
    one, four = tables
    assert one["n"] == 1 and four["n"] == 4
    for i in range(5):
        np.testing.assert_array_equal(one[f"f{i}"], four[f"f{i}"])
        np.testing.assert_allclose(one[f"v{i}"], four[f"v{i}"], rtol=1e-5, atol=1e-5)
