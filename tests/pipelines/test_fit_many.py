"""Fields for many scans: each as alone, a bad one alone in it."""

import os

import jax
import numpy as np
import pytest

from jaxgeom import RESULTS, PointCloud, fields, fit_field, fit_many, learning, stack
from jaxgeom._core import GeometryError, name_of

KEY = jax.random.key(4)
LOSS = learning.SurfaceLoss(batch=32)


def _scan(n, seed, center, size):
    x = np.random.default_rng(seed).normal(size=(n, 3))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    axes = np.array([0.45, 0.3, 0.25])
    points, normals = size * x * axes + center, x / axes
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PointCloud(np.float32(points), np.float32(normals))


def _batch():
    """Two good scans, and one of points that coincide."""
    same = PointCloud(np.ones((9, 3), np.float32), np.ones((9, 3), np.float32))
    return [_scan(40, 1, 0.0, 1.0), same, _scan(30, 2, np.array([9.0, 1, -4]), 20.0)]


def _field():
    key = jax.random.key(3)
    return learning.NeuralField.siren(key=key, radius=0.3, width=8, depth=2)


def _many(num_steps=30, rtol=0.05):
    adam = learning.Adam(num_steps=num_steps, rate=5e-3)
    choices = {"key": KEY, "loss": LOSS, "adam": adam, "rtol": rtol}
    return fit_many(_field(), stack(_batch()), **choices), choices


def test_each_is_as_alone_and_a_refused_one_keeps_its_field():
    scans, (many, choices) = _batch(), _many()
    keys = jax.random.split(KEY, 3)
    for i in (0, 2):
        rest = {**choices, "key": keys[i]}
        alone = fit_field(_field(), scans[i], throw=False, **rest)
        np.testing.assert_allclose(many[i].losses, alone.losses, rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(many[i].error, alone.error, rtol=1e-3)
        assert name_of(many[i].result) == name_of(alone.result)
        at = np.float32(scans[i].points[:5] * 1.1)
        values = [fields.value(one.field, at) for one in (many[i], alone)]
        np.testing.assert_allclose(*values, rtol=2e-3, atol=2e-3)
    assert many[1].result == RESULTS.degenerate_input
    assert "coincide" in many[1].notes[0]
    assert jax.tree.all(
        jax.tree.map(np.array_equal, many[1].unit_field, _field()),
    )
    with pytest.raises(GeometryError, match=r"clouds must be a batch.*fit_field"):
        fit_many(_field(), scans[0], key=KEY)


@pytest.mark.slow
def test_the_surfaces_go_through_the_scans():
    many, _ = _many(400, rtol=0.02)
    assert [name_of(one.result) for one in many] == [
        *("successful", "degenerate_input", "successful")
    ]
    line = np.float32([9, 1, -4]) + np.float32([[0, 0, 0], [0, 0, 7.5]])
    inside, outside = fields.value(many[2].field, line)
    assert inside < -1 and outside > 1


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 8])
def test_many_devices_equal_one(on_devices, count):
    code = f"""
import sys; sys.path.insert(0, {os.path.dirname(__file__)!r})
import jax, numpy as np
from test_fit_many import _many
found, _ = _many()
np.savez(sys.argv[1], n=jax.local_device_count(), error=[x.error for x in found],
         losses=np.array([x.losses for x in found[::2]]))
"""
    one, many = (on_devices(code, n) for n in (1, count))
    assert one["n"] == 1 and many["n"] == count
    np.testing.assert_allclose(one["losses"], many["losses"], rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(one["error"][::2], many["error"][::2], rtol=1e-3)
