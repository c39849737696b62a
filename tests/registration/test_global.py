"""Features, matching, and the alignment of real scans with no pose given."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from jaxgeom import PointCloud, Rigid
from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.normals import estimate, orient_toward_viewpoint
from jaxgeom.registration import align_features, fpfh, match_features

N, RADIUS, K = 300, 0.55, 24
CAPACITY = 600
features = jax.jit(lambda cloud: fpfh(cloud, radius=RADIUS, k=K))
matched = jax.jit(
    lambda a, b, p, q: match_features(a, b, source_mask=p, target_mask=q, tile=64)
)
align = jax.jit(
    lambda source, target, size, key: align_features(
        source, target, voxel_size=size, key=key, capacity=CAPACITY, draws=32_768
    )
)


def _bumps(n=N, seed=0):
    """Points and normals of a bumpy sheet z = h(x, y)."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-1.5, 1.5, (2, n))
    z = 0.4 * np.sin(2.1 * x) * np.cos(1.3 * y + 0.4) + 0.2 * x * y
    dx = 0.84 * np.cos(2.1 * x) * np.cos(1.3 * y + 0.4) + 0.2 * y
    dy = -0.52 * np.sin(2.1 * x) * np.sin(1.3 * y + 0.4) + 0.2 * x
    normals = np.stack([-dx, -dy, np.ones(n)], axis=1)
    return np.stack([x, y, z], axis=1), normals


def _slow_fpfh(points, normals):
    """The definition, point by point and pair by pair."""
    n = len(points)
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    distance, index = cKDTree(points).query(points, K + 1)
    near = [
        [(j, d) for j, d in zip(index[i], distance[i], strict=True) if 0 < d <= RADIUS]
        for i in range(n)
    ]
    simple = np.zeros((n, 3, 11))
    for i in range(n):
        for j, d in near[i]:
            a, b, line = unit[i], unit[j], (points[j] - points[i]) / d
            if abs(a @ line) < abs(b @ line):
                a, b, line = b, a, -line
            v = np.cross(line, a)
            v = v / np.linalg.norm(v)
            turn = np.arctan2(np.cross(a, v) @ b, a @ b)
            shares = turn / (2 * np.pi) + 0.5, (v @ b + 1) / 2, (a @ line + 1) / 2
            for group, share in enumerate(shares):
                simple[i, group, min(int(11 * share), 10)] += 100 / len(near[i])
    out = simple.copy()
    for i in range(n):
        total = sum(simple[j] / d**2 for j, d in near[i])
        out[i] += 100 * total / total.sum(axis=1, keepdims=True)
    return out.reshape(n, 33)


def test_features_are_those_of_the_definition(x64):
    points, normals = _bumps()
    ours = features(PointCloud(points, normals))
    np.testing.assert_allclose(ours, _slow_fpfh(points, normals), atol=1e-9)
    np.testing.assert_allclose(ours.reshape(N, 3, 11).sum(axis=2), 200)


def test_features_do_not_change_under_motion_order_and_padding(x64):
    points, normals = _bumps()
    expected = features(PointCloud(points, normals))
    motion = Rigid.exp(jnp.asarray([0.4, 2.0, -1.0, 3.0, -5.0, 7.0]))
    moved = features(motion(PointCloud(points, normals)))
    # A pair on the border of two bins may fall to either side.
    assert np.mean(np.abs(moved - expected) > 1e-6) < 2e-3
    shuffle = np.random.default_rng(1).permutation(N)
    mixed = features(PointCloud(points[shuffle], normals[shuffle]))
    np.testing.assert_allclose(mixed, expected[shuffle], atol=1e-9)
    mask = np.arange(N) < 220
    fill = lambda x, value: np.where(mask[:, None], x, value)
    padded = lambda v: features(PointCloud(fill(points, v), fill(normals, v), mask))
    np.testing.assert_array_equal(padded(0.0), padded(np.nan))
    alone = fpfh(PointCloud(points[:220], normals[:220]), radius=RADIUS, k=K)
    np.testing.assert_allclose(padded(0.1)[:220], alone, atol=1e-9)
    assert not np.any(padded(0.1)[220:])
    # A normal of length zero is no neighbor; a point alone has no feature.
    flat = normals.copy()
    flat[5] = 0
    assert not np.any(features(PointCloud(points, flat))[5])
    far = points.copy()
    far[7] += 100
    assert not np.any(features(PointCloud(far, normals))[7])


def test_matching_against_scipy():
    rng = np.random.default_rng(5)
    a = rng.normal(size=(150, 33)).astype(np.float32)
    b = rng.normal(size=(90, 33)).astype(np.float32)
    p, q = rng.uniform(size=150) < 0.8, rng.uniform(size=90) < 0.8
    found = matched(a, b, p, q)
    rows = np.flatnonzero(q)
    distance, nearest = cKDTree(b[q]).query(a)
    back = np.flatnonzero(p)[cKDTree(a[p]).query(b)[1]]
    mutual = p & (back[rows[nearest]] == np.arange(150))
    np.testing.assert_array_equal(found.mask, mutual)
    expected = np.where(mutual, rows[nearest], 90)
    np.testing.assert_array_equal(found.indices, expected)
    np.testing.assert_allclose(found.distances[mutual], distance[mutual], rtol=1e-5)
    assert np.all(np.isinf(found.distances[~mutual]))
    one_way = match_features(a, b, source_mask=p, target_mask=q, mutual=False)
    np.testing.assert_array_equal(one_way.indices, np.where(p, rows[nearest], 90))
    nothing = matched(a, b, p, q & False)
    assert not np.any(nothing.mask) and np.all(nothing.indices == 90)


def _scan(folder, name):
    scans = np.load(folder / "registration/stanford_bunny/bunny_scans.npz")
    points = scans[f"{name}_xyz"][::7]
    points = np.resize(points, (6000, 3))
    mask = np.arange(6000) < len(scans[f"{name}_xyz"][::7])
    far = np.array([0, 0, 10], np.float32)
    return orient_toward_viewpoint(estimate(PointCloud(points, mask=mask)), far)


@pytest.mark.slow
def test_real_scans_without_a_pose(data):
    source, target = _scan(data, "bun045"), _scan(data, "bun000")
    # bun.conf; its quaternions turn the other way.
    turn = Rotation.from_quat([0.00548449, -0.294635, -0.0038555, 0.955586])
    shift = np.array([-0.0520211, -0.000383981, -0.0109223])
    size = np.float32(0.008)
    found = align(source, target, size, jax.random.key(0))
    assert found.result == RESULTS.successful
    move = found.target_from_source
    error = Rotation.from_matrix(np.asarray(move.rotation) @ turn.as_matrix())
    assert np.degrees(error.magnitude()) < 5
    center = np.asarray(source.points).mean(axis=0)
    expected = turn.as_matrix().T @ center + shift
    assert np.linalg.norm(move(center) - expected) < 5e-3
    assert found.fitness > 0.8 and found.num_inliers <= found.num_matches
    again = align(source, target, size, jax.random.key(0))
    np.testing.assert_array_equal(again.target_from_source.matrix(), move.matrix())
    small = align(source, target, np.float32(0.003), jax.random.key(0))
    assert small.result == RESULTS.capacity_exceeded
    alone = PointCloud(source.points, source.normals, np.arange(6000) < 1)
    assert align(alone, target, size, KEY).result == RESULTS.too_few_points


KEY = jax.random.key(3)


@pytest.mark.slow
def test_unlike_shapes_have_no_consensus():
    few = np.arange(6000) < 500

    def fog(seed):
        rng = np.random.default_rng(seed)
        points, normals = rng.uniform(-1, 1, (6000, 3)), rng.normal(size=(6000, 3))
        return PointCloud(np.float32(points), np.float32(normals), few)

    found = align(fog(0), fog(1), np.float32(0.05), KEY)
    assert found.num_matches > 20
    assert found.result == RESULTS.no_consensus
    assert np.isfinite(found.target_from_source.matrix()).all()


def test_normals_are_needed():
    cloud = PointCloud(np.zeros((5, 3)))
    with pytest.raises(GeometryError, match="oriented normals"):
        fpfh(cloud, radius=1.0)
    with pytest.raises(GeometryError, match="oriented normals"):
        align_features(cloud, cloud, voxel_size=1.0, key=KEY)
    with pytest.raises(GeometryError, match="target must have shape"):
        match_features(np.zeros((5, 33)), np.zeros((5, 11)))
