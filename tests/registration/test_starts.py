"""Many starts at once, and random parts of clouds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import RESULTS, GeometryError, PointCloud, Rigid, stack
from jaxgeom.neighbors import BruteForce
from jaxgeom.registration import Method, Nearest, PointToPoint, icp_from_many
from jaxgeom.shapes import subsample

# A search that compiles in no time.
PAIRS = Nearest(backend=BruteForce())
METHOD = Method(correspondence=PAIRS, objective=PointToPoint())


def _letter(count=300, seed=0):
    """Points on three bars of different lengths: no symmetry."""
    rng = np.random.default_rng(seed)
    t, bar = rng.uniform(size=count), rng.integers(0, 3, count)
    length = np.array([1.0, 0.6, 0.35])[bar]
    points = np.zeros((count, 3))
    points[np.arange(count), bar] = t * length
    return (points + 0.01 * rng.normal(size=(count, 3))).astype(np.float32)


def _about_z(angles):
    twists = jnp.zeros((len(angles), 6)).at[:, 2].set(jnp.asarray(angles))
    return jax.vmap(Rigid.exp)(twists)


def test_best_start_wins():
    points = _letter()
    truth = Rigid.exp(jnp.array([0.0, 0.0, 2.5, 0.1, 0.2, -0.1]))
    source, target = PointCloud(points), PointCloud(truth(points))
    starts = _about_z(np.linspace(0, 2 * np.pi, 6, endpoint=False))
    run = jax.jit(
        lambda s: icp_from_many(source, target, s, method=METHOD, max_distance=0.3)
    )
    found = run(starts)
    assert found.result == RESULTS.successful
    np.testing.assert_allclose(
        found.target_from_source.matrix(), truth.matrix(), atol=1e-3
    )
    # From the first start alone it is not found, and the order does not matter.
    alone = run(jax.tree.map(lambda x: x[:1].repeat(6, 0), starts))
    assert float(alone.distance) > 2 * float(found.distance)
    other = run(jax.tree.map(lambda x: x[::-1], starts))
    np.testing.assert_allclose(other.rmse, found.rmse, atol=1e-6)


def test_hopeless_starts_are_a_status():
    points = _letter()
    far = Rigid(jnp.broadcast_to(jnp.eye(3), (2, 3, 3)), jnp.full((2, 3), 50.0))
    source = PointCloud(points)
    found = jax.jit(
        lambda s: icp_from_many(source, source, s, method=METHOD, max_distance=0.3)
    )(far)
    assert found.result == RESULTS.no_overlap


def test_subsamples_are_different_real_points():
    clouds = [PointCloud(_letter(n), attributes={"row": np.arange(n)}) for n in (40, 9)]
    batch = stack(clouds, capacity=64)
    keys = jax.random.split(jax.random.key(1), 2)
    some = jax.vmap(lambda c, k: subsample(c, 16, key=k))(batch, keys)
    assert list(np.asarray(some.mask.sum(axis=1))) == [16, 9]
    rows = np.asarray(some.attributes["row"][0])
    assert len(set(rows)) == 16
    np.testing.assert_array_equal(some.points[0], clouds[0].points[rows])
    # Every point is drawn equally often: 16 of 40.
    draw = jax.jit(
        jax.vmap(lambda k: subsample(clouds[0], 16, key=k).attributes["row"])
    )
    counts = np.bincount(np.asarray(draw(jax.random.split(keys[0], 2000))).ravel())
    assert abs(counts / 2000 - 0.4).max() < 5 * (0.4 * 0.6 / 2000) ** 0.5
    with pytest.raises(GeometryError, match="at most the room"):
        subsample(clouds[0], 41, key=keys[0])
