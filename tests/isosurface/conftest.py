"""Fields on awkward grids, and what a closed oriented manifold is."""

import types

import numpy as np
import pytest

from jaxgeom.shapes import Grid


def grid_of(shape, dtype=np.float32):
    """A grid away from the origin with three different spacings."""
    origin = np.array([0.3, -1.2, 2.0], dtype)
    return Grid(origin, np.array([0.5, 0.8, 0.3], dtype), tuple(shape))


def crosses(mesh):
    """Twice the area vector of every face, in double precision."""
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    a, b, c = corners.swapaxes(0, 1)
    return np.cross(b - a, c - a)


def volume(mesh):
    """The enclosed volume, positive where faces look outward."""
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    return np.sum(corners[:, 0] * crosses(mesh)) / 6


def assert_closed(mesh):
    """Each directed edge is there once, and its opposite once; no face twice."""
    faces, v = np.asarray(mesh.faces), mesh.vertices.shape[0]
    np.testing.assert_array_equal(np.unique(faces), np.arange(v))
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    keys, counts = np.unique(a.astype(np.int64) * v + b, return_counts=True)
    assert (counts == 1).all()
    np.testing.assert_array_equal(keys, np.unique(b.astype(np.int64) * v + a))
    assert np.unique(np.sort(faces, axis=1), axis=0).shape == faces.shape
    assert np.linalg.norm(crosses(mesh), axis=1).min() > 0
    assert volume(mesh) > 0


@pytest.fixture(scope="session")
def tools():
    """The functions above."""
    return types.SimpleNamespace(
        grid_of=grid_of, volume=volume, crosses=crosses, assert_closed=assert_closed
    )
