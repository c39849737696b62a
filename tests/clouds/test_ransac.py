"""Planes, spheres and cylinders found among outliers."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import GeometryError, PointCloud
from jaxgeom._core import RESULTS
from jaxgeom.clouds import Cylinder, Plane, Sphere, fit_primitive

NOISE, OFFSET = 0.003, np.asarray([30.0, -10.0, 20.0])
AXIS = np.asarray([1.0, 2.0, -0.5]) / np.linalg.norm([1.0, 2.0, -0.5])


def _surface(name, n, rng):
    """Points of a primitive, with normals."""
    side = np.linalg.svd(AXIS[None])[2][1:]
    if name == "plane":
        points = rng.uniform(-2, 2, (n, 2)) @ side + 0.4 * AXIS
        return points, np.broadcast_to(AXIS, points.shape)
    if name == "sphere":
        normals = rng.normal(size=(n, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        return 1.3 * normals + [0.3, -0.2, 0.5], normals
    angle = rng.uniform(0, 2 * np.pi, n)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1) @ side
    return 0.7 * normals + rng.uniform(-2, 2, (n, 1)) * AXIS + [0.3, 0, 0], normals


def _cloud(name, padding=0):
    """200 points of the primitive, 100 outliers, and padding."""
    rng = np.random.default_rng(4)
    points, normals = _surface(name, 200, rng)
    points = points + NOISE * rng.normal(size=points.shape)
    points = np.concatenate([points, rng.uniform(-2, 2, (100, 3))]) + OFFSET
    normals = normals + 0.02 * rng.normal(size=normals.shape)
    normals = np.concatenate([normals, rng.normal(size=(100, 3))])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    grow = lambda x: np.pad(x, [(0, padding), (0, 0)], constant_values=np.nan)
    mask = np.arange(300 + padding) < 300
    return PointCloud(jnp.asarray(grow(points), jnp.float32), grow(normals), mask)


MODELS = {"plane": Plane(), "sphere": Sphere(), "cylinder": Cylinder()}


@pytest.mark.parametrize("name", MODELS)
def test_finds_the_surface_among_outliers(name):
    fit = jax.jit(
        lambda c: fit_primitive(
            c, MODELS[name], threshold=4 * NOISE, key=jax.random.key(3)
        )
    )
    out = fit(_cloud(name))
    assert bool(out.result == RESULTS.successful)
    assert np.mean(out.inliers[:200]) > 0.97 and np.mean(out.inliers[200:]) < 0.1
    assert int(out.num_inliers) == int(out.inliers.sum())
    np.testing.assert_allclose(out.rmse, NOISE, rtol=0.3)
    clean = _surface(name, 50, np.random.default_rng(9))[0] + OFFSET
    heights = out.primitive.heights(jnp.asarray(clean, jnp.float32))
    # 200 points of noise sigma leave a few sigma / sqrt(200).
    assert np.abs(heights).max() < 1.5 * NOISE
    if name != "plane":
        radius = {"sphere": 1.3, "cylinder": 0.7}[name]
        np.testing.assert_allclose(out.primitive.radius, radius, atol=NOISE)


def test_padding_key_and_statuses():
    run = jax.jit(
        lambda c, key: fit_primitive(c, threshold=4 * NOISE, key=key, num_hypotheses=64)
    )
    fit = lambda c, seed=3: run(c, jax.random.key(seed))
    alone, padded = fit(_cloud("plane")), fit(_cloud("plane", padding=20))
    np.testing.assert_allclose(
        alone.primitive.normal, padded.primitive.normal, atol=1e-6
    )
    np.testing.assert_array_equal(alone.inliers, padded.inliers[:300])
    assert not padded.inliers[300:].any()
    other = fit(_cloud("plane"), seed=8)
    along = abs(float(other.primitive.normal @ alone.primitive.normal))
    np.testing.assert_allclose(along, 1, atol=1e-5)
    few = eqx.tree_at(lambda c: c.mask, _cloud("plane"), jnp.arange(300) < 2)
    assert bool(fit(few).result == RESULTS.too_few_points)
    spread = jnp.asarray(np.random.default_rng(0).uniform(size=(300, 3)), jnp.float32)
    lonely = eqx.tree_at(lambda c: c.points, _cloud("plane"), 10000 * spread)
    assert bool(fit(lonely).result == RESULTS.no_consensus)
    with pytest.raises(GeometryError, match="Cylinder samples need normals"):
        fit_primitive(
            PointCloud(few.points), Cylinder(), threshold=1.0, key=jax.random.key(0)
        )


def test_the_fit_has_a_gradient(x64):
    cloud = _cloud("sphere")
    points = jnp.asarray(cloud.points, float)
    way = jax.random.normal(jax.random.key(1), points.shape)

    @jax.jit
    def both(h):
        at = lambda t: (
            fit_primitive(
                PointCloud(points + t * way),
                Sphere(),
                threshold=6 * NOISE,
                key=jax.random.key(3),
                num_hypotheses=64,
            ).primitive.radius
        )
        return jax.jvp(at, (0.0,), (1.0,))[1], (at(h) - at(-h)) / (2 * h)

    np.testing.assert_allclose(*both(1e-6), rtol=1e-5)
