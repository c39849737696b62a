"""The doors `register`, `register_jit` and `register_many`."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import PointCloud, Rigid, stack
from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.pipelines import (
    MeanAligned,
    Pyramid,
    SharedTarget,
    _register_many,
    register,
    register_jit,
    register_many,
    share_target,
)
from jaxgeom.pipelines._pyramid import occupied

# One size, two levels: all script-form tests without normals share one program.
N, VOXEL = 1448, 0.06
TWO = Pyramid(voxels=(3.0, 0.0), gates=(12.0, 4.0), max_steps=40)
SHORT = Pyramid(voxels=(3.0,), gates=(12.0,), max_steps=2)
MOVE = np.array([0.2, -0.16, 0.1, 0.05, -0.04, 0.03])


@functools.lru_cache
def _scans():
    """Two independent samplings of one bumpy surface, the first moved back."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, N, 3))
    x = x / np.linalg.norm(x, axis=2, keepdims=True)
    bump = 1 + 0.15 * np.sin(4 * x[..., :1]) * np.cos(3 * x[..., 1:2])
    source, target = x * [1.0, 0.7, 0.5] * bump + [0.3, -0.2, 0.5]
    return np.asarray(Rigid.exp(MOVE).inverse()(source), np.float32), target.astype(
        np.float32
    )


def _align(source, target, **settings):
    return register(source, target, **{"voxel_size": VOXEL, "pyramid": TWO, **settings})


def _matrix(found):
    return np.asarray(found.target_from_source.matrix())


def _off(found):
    return np.abs(_matrix(found) - np.asarray(Rigid.exp(MOVE).matrix())).max()


@pytest.mark.slow
def test_points_alone_are_enough():
    source, target = _scans()
    found = _align(source, target)
    assert found.result == RESULTS.successful and _off(found) < 4e-3
    assert found.fitness == 1 and found.num_matches == N
    turn = np.asarray(found.target_from_source.rotation)
    assert turn.dtype == np.float64 and np.linalg.det(turn) > 0
    again = _align(PointCloud(source), PointCloud(target))
    np.testing.assert_array_equal(_matrix(again), _matrix(found))


@pytest.mark.slow
def test_far_from_the_origin():
    source, target = _scans()
    near = _align(source, target)
    away = np.array([4e6, -3e6, 5e5])
    found = _align(
        source.astype(float) + away,
        target.astype(float) + away,
        init=Rigid(np.eye(3), np.zeros(3)),
    )
    turn = np.asarray(found.target_from_source.rotation)
    np.testing.assert_allclose(turn, near.target_from_source.rotation, atol=2e-5)
    # In double precision: the same places, to single precision of the small scans.
    there = (source + away) @ turn.T + found.target_from_source.translation - away
    here = source @ np.asarray(near.target_from_source.rotation).T
    np.testing.assert_allclose(
        there, here + near.target_from_source.translation, atol=2e-5
    )


def test_points_not_finite_or_masked_are_points_removed():
    source, target = _scans()
    gone = np.zeros(N, bool)
    gone[::97] = True
    hurt = np.where(gone[:, None], np.nan, source).astype(np.float32)
    removed = _align(source[~gone], target)
    for cloud in (hurt, PointCloud(source, mask=~gone), PointCloud(hurt, mask=~gone)):
        np.testing.assert_array_equal(_matrix(_align(cloud, target)), _matrix(removed))


@pytest.mark.slow
def test_given_normals_are_used_where_both_have_them():
    source, target = _scans()
    wrong = np.broadcast_to(np.float32([0, 0, 1]), (N, 3))
    one_alone = _align(PointCloud(source, wrong), PointCloud(target))
    np.testing.assert_array_equal(_matrix(one_alone), _matrix(_align(source, target)))
    # Two searches are not enough, and along wrong normals it goes elsewhere.
    right, other = (
        _align(make(source), make(target), pyramid=SHORT, throw=False)
        for make in (_oriented, lambda points: PointCloud(points, wrong))
    )
    assert right.result == RESULTS.not_converged
    assert np.abs(_matrix(right) - _matrix(other)).max() > 1e-2
    with pytest.raises(GeometryError, match="stopped before"):
        _align(_oriented(source), _oriented(target), pyramid=SHORT)


def test_starts():
    source, target = _scans()
    with pytest.raises(GeometryError, match=r"(?s)end with success.*throw=False"):
        _align(source + 10, target)
    lost = _align(source + 10, target, throw=False)
    assert lost.result == RESULTS.no_overlap and lost.num_matches == 0
    assert np.all(np.isfinite(_matrix(lost)))
    found = _align(source + 10, target, init=MeanAligned())
    back = found.target_from_source @ Rigid(np.eye(3), np.full(3, 10.0))
    np.testing.assert_allclose(back.matrix(), Rigid.exp(MOVE).matrix(), atol=4e-3)
    given = _align(source, target, init=Rigid.exp(MOVE))
    assert given.result == RESULTS.successful and _off(given) < 4e-3
    assert given.num_steps <= _align(source, target).num_steps


def test_other_statuses():
    source, target = _scans()
    apart = source + 10
    apart[:4] = target[:4]
    few = _align(apart, target, throw=False)
    assert few.result == RESULTS.too_few_matches and few.num_matches == 4
    small = _small(*map(_oriented, (source, target)))
    assert small.result == RESULTS.capacity_exceeded
    assert np.all(np.isfinite(_matrix(small)))


def _oriented(points):
    """With rough normals: enough for a status."""
    x = (points - points.mean(axis=0)) / np.float32([1.0, 0.49, 0.25])
    return PointCloud(points, x / np.linalg.norm(x, axis=1, keepdims=True))


@eqx.filter_jit
def _small(source, target):
    size = jnp.asarray(VOXEL)
    return register_jit(source, target, voxel_size=size, rooms=(32,), pyramid=SHORT)


def test_clear_errors():
    source, target = _scans()
    with pytest.raises(GeometryError, match=r"source must have at least 6 .*5 of 5"):
        register(source[:5], target)
    with pytest.raises(GeometryError, match="target must have at least 6"):
        register(source, PointCloud(target, mask=np.arange(N) < 3))
    with pytest.raises(GeometryError, match="points must have shape"):
        register(source[:, :2], target)
    with pytest.raises(GeometryError, match="sources must be a batch"):
        register_many(PointCloud(source), PointCloud(target))
    with pytest.raises(GeometryError, match="own voxel_size and pyramid"):
        shared = SharedTarget((), target[0], VOXEL, TWO)
        register_many(stack([PointCloud(source)]), shared, voxel_size=VOXEL)
    with pytest.raises(GeometryError, match="target must have finite points"):
        share_target(PointCloud(target, mask=np.zeros(N, bool)))
    with pytest.raises(GeometryError, match="sources must be a batch"):
        many = [stack([PointCloud(target)] * b) for b in (2, 3)]
        register_many(*many)


def _batch():
    source, target = _scans()
    hurt = source[:1300].copy()
    hurt[::50] = np.nan
    sources = [source, source[:1200] + 50, hurt, source[200:1100], source[:3]]
    return [PointCloud(points) for points in sources], PointCloud(target)


def test_many_are_each_as_alone_and_share_one_program(monkeypatch):
    traces, align = [], _register_many.align_to
    counted = lambda *args: (traces.append(1), align(*args))[1]
    monkeypatch.setattr(_register_many, "align_to", counted)
    sources, target = _batch()
    settings = {"voxel_size": VOXEL, "pyramid": TWO}
    together = register_many(stack(sources), target, **settings)
    first = len(traces)
    expected = [RESULTS.successful] * 5
    expected[1], expected[4] = RESULTS.no_overlap, RESULTS.too_few_points
    for i, (source, status) in enumerate(zip(sources, expected, strict=True)):
        row = jax.tree.map(lambda x, i=i: x[i], together)
        assert row.result == status, i
        assert np.all(np.isfinite(_matrix(row)))
        if status == RESULTS.too_few_points:
            continue  # `register` raises for so few.
        alone = _align(source, target, throw=False, pyramid=TWO)
        assert alone.result == status
        assert (row.num_matches, row.num_steps) == (alone.num_matches, alone.num_steps)
        np.testing.assert_allclose(_matrix(row), _matrix(alone), atol=2e-6)
        assert status != RESULTS.successful or _off(row) < 6e-3
    # Other sizes of the same bucket.
    assert first >= 1
    again = register_many(stack(_shorter(sources)), target, **settings)
    assert len(traces) == first
    first_row = jax.tree.map(lambda x: x[0], again)
    assert first_row.result == RESULTS.successful and _off(first_row) < 4e-3


def _shorter(sources):
    return [PointCloud(s.points[: N - 7 * i]) for i, s in enumerate(sources)]


@pytest.mark.slow
def test_one_target_for_all_and_one_for_each_give_the_same_poses():
    sources, target = _batch()
    settings = {"voxel_size": VOXEL, "pyramid": TWO}
    rows = stack(_shorter(sources))
    several = stack([target] * len(sources))
    paired, shared = (register_many(rows, t, **settings) for t in (several, target))
    listed = register_many(rows, share_target(target, **settings))
    # The last has too few points: some of its moves cost nothing.
    for found in (shared, listed):
        np.testing.assert_array_equal(found.num_steps[:4], paired.num_steps[:4])
        shifts = [x.target_from_source.translation[:4] for x in (found, paired)]
        np.testing.assert_allclose(*shifts, atol=2e-6)


@pytest.mark.parametrize("side", [0.02, 0.3, 50.0])
def test_occupied_voxels_are_counted(side):
    points = np.random.default_rng(0).normal(size=(3000, 3)) * [3, 1, 0.2] + 1e5
    cells = np.floor((points - points.min(axis=0)) / side)
    assert occupied(points, side) == len(np.unique(cells, axis=0))
