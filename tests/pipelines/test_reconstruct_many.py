"""The batched door of reconstruction: each scan as alone, a bad one alone in it."""

import os

import jax
import numpy as np
import pytest
import trimesh

from jaxgeom import RESULTS, PointCloud, stack
from jaxgeom._core import GeometryError, name_of
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
        jax.tree.map(np.testing.assert_array_equal, found[i].topology, alone.topology)
        size = np.ptp(clean.points)
        vertices = found[i].mesh.vertices
        np.testing.assert_allclose(vertices, alone.mesh.vertices, atol=2e-4 * size)


@pytest.mark.slow
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
            mesh = trimesh.Trimesh(one.mesh.vertices, one.mesh.faces, process=False)
            assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
            middle = np.nanmean(scans[i].points, axis=0)
            np.testing.assert_allclose(
                mesh.center_mass, middle, atol=0.1 * mesh.extents.max()
            )


def _odd():
    """Scans that are refused, or of which something is noted; the last is good."""
    good = _float(_scan(300, 1))
    line = np.linspace(0.1, 2.0, 300)[:, None] * np.array([1.0, 0.3, -0.5])
    few, most, unknown = (np.array(good.normals) for _ in range(3))
    few[:20], most[:200], unknown[:5] = 0, 0, np.nan
    return [
        _float(PointCloud(line, np.asarray(good.normals))),
        PointCloud(good.points, most),
        PointCloud(good.points, few),
        PointCloud(good.points, unknown),
        PointCloud(good.points, -np.asarray(good.normals)),
        good,
    ]


def _agree(scans):
    """Status, notes and number of faces of every scan as alone, errors as statuses."""
    names = []
    for item, scan in zip(_many(scans), scans, strict=True):
        names.append(name_of(item.result))
        try:
            alone = reconstruct(
                scan, resolution=RESOLUTION, extractor=MarchingCubes(), throw=False
            )
        except GeometryError as error:
            assert item.notes == (str(error),) and len(item.mesh.faces) == 0
            continue
        assert item.result == alone.result and item.notes == alone.notes
        assert len(item.mesh.faces) == len(alone.mesh.faces) > 0
    return names


@pytest.mark.slow
def test_statuses_and_notes_are_those_of_each_alone():
    names = _agree(_odd())
    assert names[:3] == ["degenerate_input", "zero_normals", "zero_normals"]
    assert names[4:] == ["successful", "successful"]


@pytest.mark.slow
def test_statuses_and_notes_of_scans_without_normals():
    bare = PointCloud(np.asarray(_scan(300, 1).points, np.float32))
    flat = PointCloud(bare.points * np.array([1, 1, 0], np.float32))
    assert _agree([flat, bare]) == ["degenerate_input", "successful"]


@pytest.mark.slow
def test_weights_and_trim_are_those_of_each_alone():
    """Half of a scan is thinned, and cut off; ragged weights go with their points."""
    rng = np.random.default_rng(0)
    scans = []
    for n, seed in ((900, 1), (700, 2)):
        scan = _scan(n, seed)
        keep = (scan.points[:, 0] < 0) | (rng.random(n) < 0.05)
        scans.append(_float(PointCloud(scan.points[keep], scan.normals[keep])))
    weights = [rng.uniform(0.2, 1.0, len(scan.points)) for scan in scans]
    size = stack(scans).mask.shape[1]
    padded = np.stack([np.pad(w, (0, size - len(w))) for w in weights])
    choices = {"resolution": RESOLUTION, "extractor": MarchingCubes(), "trim": 0.3}
    many = reconstruct_many(stack(scans), weights=padded, **choices)
    for scan, weight, one in zip(scans, weights, many, strict=True):
        alone = reconstruct(scan, weights=weight, **choices)
        np.testing.assert_array_equal(one.mesh.faces, alone.mesh.faces)
        np.testing.assert_allclose(one.mesh.vertices, alone.mesh.vertices, atol=1e-4)
        assert not bool(one.topology.is_closed)
        plain = reconstruct(scan, **choices)
        assert len(plain.mesh.faces) != len(alone.mesh.faces) or not np.allclose(
            plain.mesh.vertices, alone.mesh.vertices, atol=1e-4
        )


def test_fields_that_do_not_fit_together_are_refused():
    scans = stack([_float(_scan(50, i)) for i in range(3)])
    many = jax.tree.map(lambda x: np.repeat(x, 400, axis=0), scans)
    with pytest.raises(GeometryError, match=r"(?s)memory.*fewer scans"):
        reconstruct_many(many, resolution=512)
    with pytest.raises(GeometryError, match="weights"):
        reconstruct_many(scans, resolution=RESOLUTION, weights=np.ones((3, 49)))


@pytest.mark.slow
def test_attributes_arrive_at_the_vertices():
    scans = [
        PointCloud(s.points, s.normals, None, {"x": s.points[:, :1]})
        for s in (_float(_scan(300, 1)), _float(_scan(250, 2, size=2.0)))
    ]
    for scan, item in zip(scans, _many(scans), strict=True):
        x, size = item.mesh.attributes["x"][:, 0], np.ptp(scan.points)
        np.testing.assert_allclose(x, item.mesh.vertices[:, 0], atol=0.1 * size)


def test_one_cloud_is_no_batch():
    with pytest.raises(GeometryError, match="must be a batch"):
        reconstruct_many(_float(_scan(50, 1)), resolution=RESOLUTION)


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 8])
def test_many_devices_equal_one(on_devices, count):
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
    one, many = (on_devices(code, n) for n in (1, count))
    assert one["n"] == 1 and many["n"] == count
    for i in range(5):
        np.testing.assert_array_equal(one[f"f{i}"], many[f"f{i}"])
        np.testing.assert_allclose(one[f"v{i}"], many[f"v{i}"], rtol=1e-5, atol=1e-5)
