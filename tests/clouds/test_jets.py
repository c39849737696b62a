"""Curvatures by jets: their order on irregular points, and the laws of the house."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import GeometryError, PointCloud, Rigid, stack
from jaxgeom.clouds import principal_curvatures
from jaxgeom.meshes import icosphere

SIDES = np.array([1.3, 0.7, 1.0])

found_at = jax.jit(principal_curvatures, static_argnames=("k", "degree"))


def _ellipsoid(directions):
    """Points and normals of an ellipsoid, and its principal curvatures."""
    x = directions * SIDES
    normals = x / SIDES**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    h = 1 / np.linalg.norm(x / SIDES**2, axis=1)
    gaussian = h**4 / np.prod(SIDES**2)
    mean = h**3 * (np.sum(SIDES**2) - np.sum(x**2, axis=1)) / (2 * np.prod(SIDES**2))
    half = np.sqrt(np.maximum(mean**2 - gaussian, 0))
    return PointCloud(x, normals), np.stack([mean + half, mean - half], axis=1)


def _scattered(n, seed=0):
    x = np.random.default_rng(seed).normal(size=(n, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


@pytest.mark.parametrize(
    "degree, k", [(3, 24), pytest.param(4, 32, marks=pytest.mark.slow)]
)
def test_the_worst_point_of_an_ellipsoid_converges_at_the_order(x64, degree, k):
    """Vertices with five neighbors among them, at which means over faces do not."""
    worst = []
    for level in (3, 4):
        cloud, true = _ellipsoid(np.asarray(icosphere(level).vertices, float))
        found = found_at(cloud, k=k, degree=degree)
        worst.append(np.abs(found.values - true).max())
    order = np.log2(worst[0] / worst[1])
    assert degree - 1 - 0.2 < order < degree + 1 and worst[1] < 0.07


def test_a_torus_of_random_points_and_its_directions(x64):
    """The tube bends most across itself, whatever the points are."""
    rng = np.random.default_rng(1)
    u, v = rng.uniform(0, 2 * np.pi, (2, 6000))
    ring = np.stack([np.cos(u), np.sin(u), 0 * u], axis=1)
    normals = np.cos(v)[:, None] * ring + np.sin(v)[:, None] * np.array([0, 0, 1.0])
    cloud = PointCloud(1.5 * ring + 0.5 * normals, normals)
    found = found_at(cloud)
    true = np.stack([np.full(len(u), 2.0), np.cos(v) / (1.5 + 0.5 * np.cos(v))], 1)
    error = np.abs(found.values - true)
    assert np.median(error) < 0.03 and np.quantile(error, 0.99) < 0.2
    around = np.stack([-np.sin(u), np.cos(u), 0 * u], axis=1)
    along = np.abs(np.sum(found.directions[:, 1] * around, axis=1))
    assert np.quantile(along, 0.01) > 0.99
    gram = np.einsum("nid,njd->nij", found.directions, found.directions)
    np.testing.assert_allclose(gram, np.broadcast_to(np.eye(2), gram.shape), atol=1e-9)
    across = np.einsum("nid,nd->ni", found.directions, found.normals)
    np.testing.assert_allclose(across, 0, atol=1e-9)
    assert np.sum(found.normals * normals, axis=1).min() > 0.99


def test_a_quadric_is_exact_and_follows_motion_unit_and_side(x64):
    """z = x^2 - 0.3 y^2 at the origin, from any normal near its own."""
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-0.1, 0.1, (2, 23))
    x[0] = y[0] = 0
    points = np.stack([x, y, x**2 - 0.3 * y**2], axis=1)
    tilted = np.array([0.05, -0.1, 1.0]) / np.linalg.norm([0.05, -0.1, 1.0])
    cloud = PointCloud(points, np.broadcast_to([0.0, 0.0, 1.0], points.shape))
    first = lambda cloud: jax.tree.map(lambda x: x[0], found_at(cloud, k=23))
    found = first(cloud)
    np.testing.assert_allclose(found.values, [0.6, -2.0], atol=1e-9)
    np.testing.assert_allclose(np.abs(found.directions[0]), [0, 1, 0], atol=1e-9)
    # Seen from a tilted frame the graph is no polynomial: exact to the fourth order.
    leant = first(PointCloud(points, np.broadcast_to(tilted, points.shape)))
    np.testing.assert_allclose(leant.values, [0.6, -2.0], atol=2e-2)
    assert leant.normals @ np.array([0, 0, 1]) > 0.9999
    motion = Rigid.exp(jnp.array([0.4, -1.0, 0.3, 5.0, 2.0, -7.0]))
    moved = first(motion(cloud))
    np.testing.assert_allclose(moved.values, found.values, atol=1e-9)
    larger = first(PointCloud(3 * points, cloud.normals))
    np.testing.assert_allclose(larger.values, found.values / 3, atol=1e-9)
    inside = first(PointCloud(points, -cloud.normals))
    np.testing.assert_allclose(inside.values, -found.values[::-1], atol=1e-9)


@pytest.mark.slow
def test_gradients_are_central_differences(x64):
    cloud, _ = _ellipsoid(_scattered(60))
    rng = np.random.default_rng(3)
    probe = jnp.asarray(rng.normal(size=(60, 3)))
    ways = [jnp.asarray(rng.normal(size=(60, 3))) for _ in range(2)]

    @jax.jit
    def told(points, normals):
        found = principal_curvatures(PointCloud(points, normals), k=20)
        squares = jnp.sum(found.directions[:, 0] ** 2 * jnp.arange(3), axis=1)
        numbers = jnp.concatenate([found.values, squares[:, None]], axis=1)
        return jnp.sum(probe * numbers)

    start, eps = (cloud.points, cloud.normals), 1e-6
    slopes = jax.jit(jax.grad(told, argnums=(0, 1)))(*start)
    step = lambda s: told(*(x + s * way for x, way in zip(start, ways, strict=True)))
    difference = (step(eps) - step(-eps)) / (2 * eps)
    slope = sum(jnp.sum(g * way) for g, way in zip(slopes, ways, strict=True))
    np.testing.assert_allclose(slope, difference, rtol=1e-6)


@pytest.mark.slow
def test_padding_batches_and_places_without_a_surface():
    """Each of a ragged batch as alone; too few points and lost normals give zeros."""
    first, _ = _ellipsoid(_scattered(90, 1))
    normals = np.array(first.normals)
    normals[7] = 0
    clouds = [
        PointCloud(np.float32(first.points), np.float32(normals)),
        PointCloud(np.float32(first.points[:9]), np.float32(normals[:9])),
        PointCloud(np.ones((50, 3), np.float32), np.float32(first.normals[:50])),
    ]
    batch = stack(clouds)
    found = jax.jit(jax.vmap(principal_curvatures))(batch)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found))
    assert not np.any(found.values[0, 7]) and np.any(found.values[0, 8])
    assert not np.any(found.values[1]) and not np.any(found.normals[1])
    assert not np.any(found.values[2])
    alone = found_at(clouds[0])
    np.testing.assert_allclose(found.values[0, :90], alone.values, rtol=2e-3, atol=2e-3)
    assert not np.any(found.values[0, 90:])
    square = lambda x, c: jnp.sum(
        principal_curvatures(PointCloud(x, c.normals, c.mask)).values ** 2
    )
    slopes = jax.jit(jax.vmap(jax.grad(square)))(batch.points, batch)
    assert np.isfinite(slopes).all() and not np.any(slopes[0, 90:])


def test_what_cannot_be_fitted_is_an_error():
    cloud, _ = _ellipsoid(_scattered(30))
    with pytest.raises(GeometryError, match="with normals"):
        principal_curvatures(PointCloud(cloud.points))
    for settings in ({"degree": 5}, {"degree": 1}, {"k": 9}, {"degree": 4, "k": 14}):
        with pytest.raises(GeometryError, match="degree must be 2, 3 or 4"):
            principal_curvatures(cloud, **settings)
