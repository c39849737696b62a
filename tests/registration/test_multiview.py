"""All scans of one object at once: the pairs, the tree of poses, the joint solution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgeom as jg
from jaxgeom import RESULTS, Rigid
from jaxgeom.registration import (
    GlobalStart,
    ViewGraph,
    match_views,
    multiview,
    spanning_poses,
)

CENTER = np.array([0.1, -0.2, 0.4])


def _blob(count, seed=0):
    """A lumpy closed surface without symmetries: points and normals."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)

    def radius(d):
        x, y, z = d.T
        waves = 0.15 * jnp.sin(3 * x + 1) * jnp.cos(4 * y) + 0.1 * jnp.sin(
            5 * z + 2 * x
        )
        return 1 + 0.2 * x + waves

    position = lambda d: (
        (d / jnp.linalg.norm(d)) * radius((d / jnp.linalg.norm(d))[None])
    )
    points = jax.vmap(position)(d)
    # The gradient of |p| / radius(direction of p) is normal to the surface.
    inside = lambda p: jnp.linalg.norm(p) / radius((p / jnp.linalg.norm(p))[None])[0]
    normals = jax.vmap(jax.grad(inside))(points)
    normals /= jnp.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(points) + CENTER, np.asarray(normals)


def _turns(count, seed, angle):
    rng = np.random.default_rng(seed)
    twists = rng.normal(size=(count, 6)) * angle
    return jax.vmap(Rigid.exp)(jnp.asarray(twists, jnp.float32))


@pytest.fixture(scope="module")
def views():
    """Four overlapping parts of the blob, each moved, and their true poses."""
    points, normals = _blob(6000)
    looks = [(1, 0, 0), (0, 1, 0), (-1, 0, 0.3), (0, -1, -0.3)]
    truth = _turns(4, 1, 0.8)
    scans = []
    for i, look in enumerate(looks):
        seen = (points - CENTER) @ np.array(look) > -0.25
        back = jax.tree.map(lambda x, i=i: x[i], truth).inverse()
        cloud = jg.PointCloud(
            points[seen].astype(np.float32), normals[seen].astype(np.float32)
        )
        scans.append(jax.tree.map(np.asarray, back(cloud)))
    relative = jax.vmap(lambda t: _at(truth, 0).inverse() @ t)(truth)
    return jg.stack(scans, capacity=4600), relative


def _at(tree, i):
    return jax.tree.map(lambda x: x[i], tree)


def _errors(found, truth):
    """Angles in radians and distances at the center, of the differences."""
    gap = jax.vmap(lambda a, b: a @ b.inverse())(found, truth)
    angle = jnp.linalg.norm(jax.vmap(lambda g: g.log())(gap)[:, :3], axis=1)
    here = jax.vmap(lambda g: g(jnp.asarray(CENTER, jnp.float32)))(gap)
    return np.asarray(angle), np.linalg.norm(np.asarray(here) - CENTER, axis=1)


_solve = jax.jit(lambda clouds, start: multiview(clouds, start, voxel_size=0.06))


@pytest.mark.slow
def test_joint_poses_are_exact_for_one_surface(views):
    clouds, truth = views
    off = _turns(4, 2, 0.05)
    start = jax.vmap(lambda a, b: a @ b)(off, truth)
    # The first pose is the gauge: everything is measured from it.
    start = jax.vmap(lambda t: _at(start, 0).inverse() @ t)(start)
    out = _solve(clouds, start)
    assert out.result == RESULTS.successful
    angle, distance = _errors(out.world_from_scan, truth)
    before, _ = _errors(start, truth)
    assert before.max() > 0.03
    assert angle.max() < 2e-3 and distance.max() < 2e-3
    assert np.all(np.asarray(out.num_matches) > 500)
    assert float(out.rmse) < 0.01


@pytest.mark.slow
def test_padding_and_order_do_not_change_the_poses(views):
    clouds, truth = views
    start = jax.vmap(lambda a, b: a @ b)(_turns(4, 3, 0.02), truth)
    one = _solve(clouds, start)
    order = np.random.default_rng(0).permutation(clouds.points.shape[1])
    other = _solve(jax.tree.map(lambda x: x[:, order], clouds), start)
    angle, distance = _errors(one.world_from_scan, other.world_from_scan)
    assert angle.max() < 2e-4 and distance.max() < 2e-4


@pytest.mark.slow
def test_a_scan_far_from_all_others_is_a_status(views):
    clouds, truth = views
    away = truth.translation.at[2].add(50.0)
    out = _solve(clouds, Rigid(truth.rotation, away))
    assert out.result == RESULTS.no_consensus
    assert int(out.num_matches[2]) == 0 and np.all(np.isfinite(out.rmse))
    np.testing.assert_allclose(out.world_from_scan.translation[2], away[2], atol=1e-4)


@pytest.mark.slow
def test_too_little_room_is_a_status(views):
    clouds, truth = views
    out = jax.jit(
        lambda c, t: multiview(c, t, voxel_size=0.06, capacity=200, levels=(1.0,))
    )(clouds, truth)
    assert out.result == RESULTS.capacity_exceeded


def test_clouds_without_normals_are_an_error(views):
    clouds, truth = views
    bare = jg.PointCloud(clouds.points[0], None)
    bare = jax.tree.map(lambda x: np.stack([x] * 4), bare)
    with pytest.raises(jg.GeometryError, match="needs oriented normals"):
        multiview(bare, truth, voxel_size=0.06)
    with pytest.raises(jg.GeometryError, match="start.translation"):
        multiview(clouds, _turns(3, 0, 0.1), voxel_size=0.06)


def _graph(edges, poses):
    """A graph of true relative poses with given scores."""
    pairs = jnp.asarray([(i, j) for i, j, _ in edges])
    relative = [_at(poses, i).inverse() @ _at(poses, j) for i, j, _ in edges]
    relative = jax.tree.map(lambda *x: jnp.stack(x), *relative)
    count = jnp.ones(len(edges), jnp.int32)
    good = jnp.zeros(len(edges))
    starts = GlobalStart(relative, count, count, good, good, RESULTS.successful)
    return ViewGraph(pairs, starts, jnp.asarray([s for _, _, s in edges], jnp.float32))


def test_poses_follow_the_strongest_pairs():
    poses = _turns(5, 7, 1.0)
    edges = [(0, 1, 1.0), (1, 2, 5.0), (0, 2, 3.0), (2, 3, 2.0), (0, 3, 0.5)]
    edges += [(0, 4, 0.0), (3, 4, 0.0)]
    out = spanning_poses(_graph(edges, poses), 5)
    assert list(np.asarray(out.parent)) == [0, 2, 0, 2, 4]
    assert list(np.asarray(out.reached)) == [True, True, True, True, False]
    relative = jax.vmap(lambda t: _at(poses, 0).inverse() @ t)(poses)
    np.testing.assert_allclose(
        out.world_from_scan.rotation[:4], relative.rotation[:4], atol=1e-5
    )
    np.testing.assert_allclose(out.world_from_scan.rotation[4], np.eye(3), atol=1e-6)


@pytest.mark.slow
def test_four_views_without_any_pose(views):
    clouds, truth = views
    graph = jax.jit(lambda c: match_views(c, voxel_size=0.15, key=jax.random.key(0)))(
        clouds
    )
    rough = spanning_poses(graph, 4)
    assert bool(jnp.all(rough.reached))
    out = _solve(clouds, rough.world_from_scan)
    angle, distance = _errors(out.world_from_scan, truth)
    assert angle.max() < 2e-3 and distance.max() < 2e-3
