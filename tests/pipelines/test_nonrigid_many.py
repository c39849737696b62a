"""A template on many scans: each as alone, a bad one alone in it."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import GeometryError, PointCloud, nonrigid_many, stack
from jaxgeom._core import name_of
from jaxgeom.meshes import icosphere
from jaxgeom.registration import StiffnessSchedule, nonrigid

SETTINGS = {"schedule": StiffnessSchedule(stages=3), "max_distance": 0.6}
AXES = np.array([[1.1, 0.9, 0.8], [0.8, 1.2, 1.0], [1.0, 1.0, 1.25]])


def _scans():
    """Three ellipsoids, and a scan without points."""
    scans = []
    for i, axes in enumerate(AXES):
        x = np.random.default_rng(i).normal(size=(150 + 20 * i, 3))
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        normals = x / axes
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        scans.append(PointCloud(np.float32(x * axes), np.float32(normals)))
    points = np.array(scans[0].points)
    points[3] = np.nan
    scans[0] = PointCloud(points, scans[0].normals)
    none = np.full((5, 3), np.nan, np.float32)
    return [*scans, PointCloud(none, np.ones_like(none))]


def _many():
    return nonrigid_many(icosphere(2), stack(_scans()), **SETTINGS)


@pytest.mark.slow
def test_each_is_as_alone_and_lies_on_its_scan():
    found, template = _many(), icosphere(2)
    each = [jax.tree.map(lambda x, i=i: x[i], found) for i in range(4)]
    names = [name_of(one.result) for one in each]
    assert names[3] == "too_few_points" and not {"too_few_points"} & set(names[:3])
    # A template that is a constant rounds differently, and pairs then flip.
    alone = jax.jit(lambda mesh, scan: nonrigid(mesh, scan, **SETTINGS))
    scan = stack([_scans()[2]], capacity=stack(_scans()).points.shape[1])
    scan = jax.tree.map(lambda x: jnp.asarray(x[0]), scan)
    same = jax.tree.map(jnp.asarray, template)
    np.testing.assert_allclose(
        each[2].mesh.vertices, alone(same, scan).mesh.vertices, atol=2e-4
    )
    for axes, one in zip(AXES, each[:3], strict=True):
        assert np.array_equal(one.mesh.faces, template.faces)
        radius = np.linalg.norm(one.mesh.vertices / axes, axis=1)
        assert abs(radius - 1).max() < 0.1 and float(one.fitness) > 0.9
    with pytest.raises(GeometryError, match="must be a batch.*nonrigid"):
        nonrigid_many(template, _scans()[1])


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 8])
def test_many_devices_equal_one(on_devices, count):
    code = f"""
import sys; sys.path.insert(0, {os.path.dirname(__file__)!r})
import jax, numpy as np
from test_nonrigid_many import _many
found = _many()
np.savez(sys.argv[1], n=jax.local_device_count(), v=found.mesh.vertices, r=found.rmse)
"""
    one, many = (on_devices(code, n) for n in (1, count))
    assert one["n"] == 1 and many["n"] == count
    np.testing.assert_allclose(one["v"], many["v"], atol=2e-4)
