"""The batched door of extraction: each field as alone, divided among devices."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import Grid, extract_many
from jaxgeom._core import GeometryError, name_of
from jaxgeom.fields import Box, Sphere, sample
from jaxgeom.isosurface import DualContouring, FlexiCubes, MarchingCubes, extract

GRID = Grid(np.full(3, -1.0, np.float32), np.full(3, 0.2, np.float32), (11, 11, 11))
RADII = np.array([0.75, 0.3, 3.0, 0.9, 0.5], np.float32)


def _same(one, other):
    assert name_of(one.result) == name_of(other.result)
    np.testing.assert_array_equal(one.mesh.faces, other.mesh.faces)
    np.testing.assert_allclose(one.mesh.vertices, other.mesh.vertices, atol=1e-6)
    for name in ("vertices", "faces", "cells"):
        name = f"required_{name}"
        assert int(getattr(one, name)) == int(getattr(other, name))


def test_each_is_as_alone_and_an_empty_one_spoils_nothing():
    balls = jax.vmap(Sphere)(jnp.asarray(RADII))
    many = extract_many(balls, GRID)
    assert [name_of(one.result) for one in many] == [
        *("successful", "successful", "no_surface", "successful", "successful")
    ]
    for i in (0, 2):
        _same(many[i], extract(Sphere(RADII[i]), GRID))


@pytest.mark.slow
@pytest.mark.parametrize("method", [MarchingCubes(), DualContouring(), FlexiCubes()])
@pytest.mark.parametrize("closed", [False, True])
def test_fields_samples_and_levels_agree(method, closed):
    """A surface that leaves the grid is closed, or open, as `extract` leaves it."""
    boxes = jax.vmap(lambda a: Box(jnp.array([0.5, 1.5, 0.3]) * a))(jnp.asarray(RADII))
    levels = np.array([0.0, 0.05, 0.0, -0.1, 0.1], np.float32)
    choices = {"method": method, "closed": closed}
    many = extract_many(boxes, GRID, levels, **choices)
    for i, one in enumerate(many):
        box = jax.tree.map(lambda x, i=i: x[i], boxes)
        _same(one, extract(box, GRID, levels[i], **choices))
    values = jnp.stack([sample(Sphere(r), GRID) for r in RADII])
    for value, one in zip(values, extract_many(values, GRID, **choices), strict=True):
        _same(one, extract(value, GRID, **choices))


def test_samples_of_numpy_are_taken():
    values = np.stack([np.asarray(sample(Sphere(r), GRID)) for r in RADII[:2]])
    for radius, one in zip(RADII, extract_many(values, GRID), strict=False):
        _same(one, extract(sample(Sphere(radius), GRID), GRID))


def test_what_is_no_batch_is_refused():
    wrong = [
        np.zeros((11, 11, 11)),
        np.zeros((2, 11, 11, 12)),
        np.zeros((0, 11, 11, 11)),
    ]
    for fields in (*wrong, Sphere(0.5)):
        with pytest.raises(GeometryError, match="leading axis b"):
            extract_many(fields, GRID)


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 8])
def test_many_devices_equal_one(on_devices, count):
    """Five fields are no multiple of the devices."""
    code = f"""
import sys; sys.path.insert(0, {os.path.dirname(__file__)!r})
import jax, numpy as np
from test_extract_many import GRID, RADII
from jaxgeom import extract_many
from jaxgeom.fields import Sphere
found = extract_many(jax.vmap(Sphere)(RADII), GRID)
np.savez(sys.argv[1], n=jax.local_device_count(),
         **{{f"v{{i}}": item.mesh.vertices for i, item in enumerate(found)}},
         **{{f"f{{i}}": item.mesh.faces for i, item in enumerate(found)}})
"""
    one, many = (on_devices(code, n) for n in (1, count))
    assert one["n"] == 1 and many["n"] == count
    for i in range(5):
        np.testing.assert_array_equal(one[f"f{i}"], many[f"f{i}"])
        np.testing.assert_allclose(one[f"v{i}"], many[f"v{i}"], atol=1e-6)


def test_a_batch_is_divided_evenly(on_devices):
    """Each device has as many items as any other; the last is repeated."""
    code = """
import sys, jax, numpy as np
from jaxgeom.pipelines._devices import placed
shares = lambda b: placed(np.arange(b))[0].addressable_shards
rows = [[share.data for share in shares(b)] for b in (5, 8, 13)]
np.savez(sys.argv[1], **{str(i): np.stack(x) for i, x in enumerate(rows)})
"""
    found = on_devices(code, 4)
    assert [found[str(i)].shape for i in range(3)] == [(4, 2), (4, 2), (4, 4)]
    np.testing.assert_array_equal(found["2"].ravel(), [*range(13), 12, 12, 12])
