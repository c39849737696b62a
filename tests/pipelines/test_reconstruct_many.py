"""The batched door of reconstruction: each scan as alone, a bad one alone in it."""

import os
import subprocess
import sys

import numpy as np
import pytest

from jaxgeom import RESULTS, PointCloud, stack
from jaxgeom._core import GeometryError
from jaxgeom.isosurface import MarchingCubes
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


def _many(scans):
    """With the extractor that compiles fastest."""
    return reconstruct_many(
        stack(scans), resolution=RESOLUTION, extractor=MarchingCubes()
    )


def _float(cloud):
    return PointCloud(
        *(np.asarray(x, np.float32) for x in (cloud.points, cloud.normals))
    )


@pytest.mark.slow
def test_each_is_as_alone():
    scans = [_float(scan) for scan in _batch()]
    found = reconstruct_many(stack(scans), resolution=RESOLUTION)
    for i in (0, 2, 4):
        scan = scans[i]
        there = np.isfinite(scan.points).all(axis=1)
        clean = PointCloud(scan.points[there], scan.normals[there])
        alone = reconstruct(clean, resolution=RESOLUTION)
        assert found[i].result == alone.result
        np.testing.assert_array_equal(found[i].mesh.faces, alone.mesh.faces)
        size = np.ptp(clean.points)
        vertices = found[i].mesh.vertices
        np.testing.assert_allclose(vertices, alone.mesh.vertices, atol=2e-4 * size)


def test_bad_scans_spoil_nothing_and_order_does_not_matter():
    scans = [_float(scan) for scan in _batch()]
    forth, back = _many(scans), _many(scans[::-1])[::-1]
    wrong = {1: RESULTS.too_few_points, 3: RESULTS.degenerate_input}
    for i, (one, other) in enumerate(zip(forth, back, strict=True)):
        assert one.result == wrong.get(i, RESULTS.successful), i
        assert one.result == other.result
        np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)
        np.testing.assert_array_equal(one.mesh.faces, other.mesh.faces)
        assert (len(one.mesh.faces) == 0) == (i in wrong)
        if i not in wrong:
            gap = np.asarray(one.mesh.vertices).mean(axis=0)
            middle = np.nanmean(scans[i].points, axis=0)
            assert np.max(np.abs(gap - middle)) < 0.2 * np.nanmax(
                np.ptp(one.mesh.vertices)
            )
            edges = np.asarray(one.mesh.faces)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
            # Closed and oriented: every directed edge has its opposite, once.
            pairs = set(map(tuple, edges))
            assert len(pairs) == len(edges)
            assert pairs == {(j, i) for i, j in pairs}


def test_what_is_refused_alone_has_a_status_here():
    good = _float(_scan(300, 1))
    line = np.linspace(0.1, 2.0, 300)[:, None] * np.array([1.0, 0.3, -0.5])
    few, most = (np.array(good.normals) for _ in range(2))
    few[:20], most[:200] = 0, 0
    scans = [
        _float(PointCloud(line, np.asarray(good.normals))),
        PointCloud(good.points, most),
        PointCloud(good.points, few),
        PointCloud(good.points, -np.asarray(good.normals)),
        good,
    ]
    found = _many(scans)
    names = ["degenerate_input", "zero_normals", "zero_normals", *["successful"] * 2]
    for i, (item, name) in enumerate(zip(found, names, strict=True)):
        assert item.result == getattr(RESULTS, name), i
        assert (len(item.mesh.faces) == 0) == (i < 2)
        if i < 2:
            with pytest.raises(GeometryError):
                reconstruct(scans[i], resolution=RESOLUTION)
    assert "inverted" in found[3].notes[0] and found[4].notes == ()


@pytest.mark.slow
def test_a_plane_without_normals_has_no_inside():
    bare = PointCloud(np.asarray(_scan(300, 1).points, np.float32))
    flat = PointCloud(bare.points * np.array([1, 1, 0], np.float32))
    one, other = _many([flat, bare])
    assert one.result == RESULTS.degenerate_input and len(one.mesh.faces) == 0
    assert other.result == RESULTS.successful and len(other.mesh.faces) > 0


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
