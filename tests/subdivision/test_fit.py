"""Control meshes fitted to points."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import RESULTS, GeometryError, PointCloud, PolygonMesh
from jaxgeom.meshes import icosphere
from jaxgeom.subdivision import (
    CatmullClark,
    Creases,
    Loop,
    fit_control_mesh,
    limit,
    subdivide,
)

AXES = np.array([1.3, 0.9, 0.7])


def egg(n=400):
    """Points on an ellipsoid."""
    x = np.random.default_rng(0).normal(size=(n, 3))
    return np.float32(AXES * x / np.linalg.norm(x, axis=1, keepdims=True))


def fit(points, **settings):
    settings = {"levels": 1, "smoothness": 1e-4, "max_steps": 18} | settings
    return fit_control_mesh(points, icosphere(1), **settings)


def test_the_limit_surface_meets_the_points():
    out = fit(egg())
    assert out.result == RESULTS.successful
    rms, last = np.asarray(out.rms), int(out.steps)
    assert rms[0] > 0.15 and rms[last] < 3e-3
    assert np.all(np.diff(out.energies) <= 0)
    np.testing.assert_array_equal(rms[last:], rms[last])
    # The surface is the limit of the cage, by the operator and anew.
    np.testing.assert_allclose(
        out.operator @ out.cage.vertices, out.surface.vertices, atol=1e-6
    )
    fine = subdivide(out.cage, 1, scheme=Loop())
    again = limit(fine.mesh).position @ fine.mesh.vertices
    np.testing.assert_allclose(again, out.surface.vertices, atol=1e-5)
    level = np.linalg.norm(np.asarray(out.surface.vertices) / AXES, axis=1)
    # Facets of this size sag by about a hundredth.
    assert np.abs(level - 1).max() < 0.04


def test_points_that_do_not_count_change_nothing():
    points = egg()
    points[7], points[11] = np.nan, 50.0
    mask = np.ones(len(points), bool)
    mask[11] = False
    spoilt = fit(PointCloud(jnp.asarray(points), mask=mask))
    points[7] = points[11] = points[0]
    kept = np.ones(len(points), bool)
    kept[[7, 11]] = False
    clean = fit(PointCloud(jnp.asarray(points), mask=kept))
    np.testing.assert_allclose(spoilt.cage.vertices, clean.cage.vertices, atol=1e-6)


def test_statuses():
    assert fit(egg(), max_steps=17, rtol=0.0).result == (
        RESULTS.nonlinear_max_steps_reached
    )
    nothing = PointCloud(egg(), mask=np.zeros(400, bool))
    assert fit(nothing).result == RESULTS.too_few_points


def test_bad_settings_are_errors():
    for name in ("smoothness", "rtol"):
        with pytest.raises(GeometryError, match=f"{name} must be at least 0"):
            fit(egg(), **{name: -1.0})
    with pytest.raises(GeometryError, match="max_steps must be at least 1"):
        fit(egg(), max_steps=0)


def tin(n=600):
    """Points on a closed cylinder of radius 1 and height 1.6."""
    generator = np.random.default_rng(1)
    angle, height = 2 * np.pi * generator.random(n), generator.uniform(-0.8, 0.8, n)
    side = np.stack([np.cos(angle), np.sin(angle), height], -1)
    lids = side * np.sqrt(generator.random(n))[:, None]
    lids[:, 2] = np.where(np.arange(n) % 2, 0.8, -0.8)
    return np.float32(np.concatenate([side, lids]))


def drum(sides=8):
    """A prism around the cylinder, with its two rims as creases."""
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    i, j = np.arange(sides), (np.arange(sides) + 1) % sides
    up = [0, 0, 0.7]
    walls = np.stack([i, j, j + sides, i + sides], -1)
    lids = np.stack([i[::-1], i + sides])
    rims = np.concatenate([np.stack([i, j], -1), np.stack([i, j], -1) + sides])
    return PolygonMesh(np.concatenate([ring - up, ring + up]), (walls, lids)), rims


@pytest.mark.slow
def test_creases_let_a_cage_fit_sharp_rims():
    cage, rims = drum()
    settings = {"scheme": CatmullClark(), "smoothness": 1e-5}
    sharp = fit_control_mesh(tin(), cage, creases=Creases(rims), **settings)
    smooth = fit_control_mesh(tin(), cage, **settings)
    last = lambda out: float(out.rms[-1])
    assert isinstance(sharp.cage, PolygonMesh)
    assert sharp.rms[0] > 0.05 and last(sharp) < 0.01
    assert last(smooth) > 3 * last(sharp)
