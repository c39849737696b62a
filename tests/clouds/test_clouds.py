"""Thinning, outliers, neighborhoods and boxes of clouds, against scipy and numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from jaxgeom import GeometryError, PointCloud, Rigid
from jaxgeom._core import RESULTS
from jaxgeom.clouds import (
    MinimalVolume,
    PrincipalAxes,
    bounding_box,
    crop,
    density,
    farthest_points,
    keep,
    merge,
    nearest_graph,
    oriented_box,
    principal_frames,
    radius_inliers,
    statistical_inliers,
    surface_variation,
    voxel_downsample,
)

SIZE = 0.31


def _points(n=300, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3))
    x = x / np.linalg.norm(x, axis=1, keepdims=True) + 0.02 * rng.normal(size=(n, 3))
    return (x * [1.3, 0.7, 2.1] + [3, -1, 2]).astype(np.float32)


def _cloud(padding=20):
    """A cloud of 300 points with normals and colors, and padding full of rubbish."""
    points = _points()
    n = len(points)
    normals = points - points.mean(axis=0)
    colors = np.random.default_rng(1).uniform(size=(n, 2, 2)).astype(np.float32)
    grow = lambda x: np.concatenate([x, np.full((padding, *x.shape[1:]), 7e3, x.dtype)])
    mask = np.arange(n + padding) < n
    return PointCloud(grow(points), grow(normals), mask, {"colors": grow(colors)})


thinned = jax.jit(voxel_downsample, static_argnames="capacity")
statistical = jax.jit(lambda c: statistical_inliers(c, k=8, ratio=1.0))
within = jax.jit(lambda c, r: radius_inliers(c, r, least=4))
local = jax.jit(
    lambda c: (principal_frames(c, k=12), surface_variation(c, k=12), density(c, k=8))
)


def test_voxels_hold_the_means_of_what_is_in_them():
    cloud, n = _cloud(), 300
    corner = np.float32([2.05, -2.2, -0.9])
    out = thinned(cloud, SIZE, origin=corner)
    points = np.asarray(cloud.points)[:n]
    cells = np.floor((points - corner) / np.float32(SIZE)).astype(int)
    voxels, which = np.unique(cells, axis=0, return_inverse=True)
    assert int(out.required_points) == len(voxels) < n
    small = out.cloud.trim()
    mean = lambda x: np.stack([x[which == i].mean(axis=0) for i in range(len(voxels))])
    np.testing.assert_allclose(small.points, mean(points), atol=2e-6)
    normals = mean(np.asarray(cloud.normals)[:n])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(small.normals, normals, atol=1e-5)
    colors = mean(np.asarray(cloud.attributes["colors"])[:n])
    np.testing.assert_allclose(small.attributes["colors"], colors, atol=2e-6)
    tight = thinned(cloud, SIZE, origin=corner, capacity=16)
    assert bool(tight.result == RESULTS.capacity_exceeded)
    assert int(tight.required_points) == len(voxels)
    np.testing.assert_array_equal(tight.cloud.points, small.points[:16])


def test_gradients_of_voxel_means_leave_padding_alone():
    cloud = _cloud()
    weights = jnp.asarray(np.random.default_rng(3).normal(size=(320, 3)))

    @jax.jit
    def loss(points):
        out = voxel_downsample(PointCloud(points, mask=cloud.mask), SIZE)
        return jnp.sum(
            jnp.where(out.cloud.mask[:, None], weights, 0) * out.cloud.points
        )

    slope = jax.grad(loss)(jnp.asarray(cloud.points))
    assert (slope[300:] == 0).all() and jnp.isfinite(slope).all()
    # Each voxel shares out the weight of its mean.
    count = int(thinned(cloud, SIZE).required_points)
    np.testing.assert_allclose(
        slope.sum(axis=0), weights[:count].sum(axis=0), rtol=1e-4
    )


def test_outliers_are_those_of_scipy():
    cloud, n = _cloud(), 300
    points = np.asarray(cloud.points, float)[:n]
    tree = cKDTree(points)
    apart = tree.query(points, 9)[0][:, 1:].mean(axis=1)
    want = apart < apart.mean() + apart.std(ddof=1)
    found = statistical(cloud)
    np.testing.assert_array_equal(found[:n], want)
    assert not found[n:].any() and 0.02 < 1 - want.mean() < 0.4
    count = [len(x) - 1 for x in tree.query_ball_point(points, SIZE)]
    found = within(cloud, SIZE)
    np.testing.assert_array_equal(found[:n], np.asarray(count) >= 4)
    assert not found[n:].any() and 0.05 < found[:n].mean() < 0.95
    assert int(keep(cloud, found).num_points) == int(found.sum())
    with pytest.raises(GeometryError, match="at least 1"):
        radius_inliers(cloud, SIZE, least=0)


@pytest.mark.slow
def test_frames_and_density_are_those_of_numpy():
    cloud, n = _cloud(), 300
    points = np.asarray(cloud.points, float)[:n]
    distances, near = cKDTree(points).query(points, 12)
    gaps = points[near] - points[near].mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", gaps, gaps) / 12)
    frame, variation, packed = local(cloud)
    np.testing.assert_allclose(frame.variances[:n], values, atol=1e-5)
    along = np.abs(np.einsum("nia,nia->na", frame.axes[:n], vectors))
    clear = np.min(np.diff(values, axis=1), axis=1) > 0.05 * values[:, 2]
    np.testing.assert_allclose(along[clear], 1, atol=1e-4)
    np.testing.assert_allclose(frame.centers[:n], points[near].mean(axis=1), atol=1e-5)
    want = values[:, 0] / values.sum(axis=1)
    np.testing.assert_allclose(variation[:n], want, atol=1e-4)
    np.testing.assert_allclose(
        packed[:n], 8 / (np.pi * distances[:, 8] ** 2), rtol=1e-4
    )
    for x in (frame.variances, frame.axes, variation, packed):
        assert (np.asarray(x[n:]) == 0).all()
    graph = nearest_graph(cloud, 12)
    np.testing.assert_allclose(graph.distances[:n], distances, atol=1e-5)
    rows = jnp.asarray([5, len(cloud.points), 0, 3])
    some = nearest_graph(cloud, 12, rows=rows)
    np.testing.assert_allclose(some.distances[::2], distances[[5, 0]], atol=1e-5)
    assert some.mask[::2].all() and not some.mask[1].any()


@pytest.mark.slow
def test_variances_have_the_gradient_of_central_differences(x64):
    points = jnp.asarray(_points(40), float)
    way = jax.random.normal(jax.random.key(0), points.shape)

    @jax.jit
    def both(h):
        at = lambda t: principal_frames(PointCloud(points + t * way), k=12).variances
        return jax.jvp(at, (0.0,), (1.0,))[1], (at(h) - at(-h)) / (2 * h)

    np.testing.assert_allclose(*both(1e-6), rtol=1e-6, atol=1e-8)


def test_farthest_points_cover():
    cloud = _cloud()
    out = farthest_points(cloud, 25)
    chosen = np.asarray(out.points)
    assert out.mask.all() and len(np.unique(chosen, axis=0)) == 25
    # Greedy in plain numpy gives the same points in the same order.
    points = np.asarray(cloud.points)[:300]
    rows, apart = [0], np.full(300, np.inf)
    for _ in range(24):
        apart = np.minimum(apart, ((points - points[rows[-1]]) ** 2).sum(axis=1))
        rows.append(int(apart.argmax()))
    np.testing.assert_array_equal(chosen, points[rows])
    few = farthest_points(keep(cloud, np.arange(320) % 40 == 3), 25)
    assert int(few.num_points) == 8 and len(np.unique(few.trim().points, axis=0)) == 8
    with pytest.raises(GeometryError, match="num must be at least 1"):
        farthest_points(cloud, 0)


def test_boxes_hold_the_points_and_minimal_ones_are_small():
    rng = np.random.default_rng(2)
    sides = np.asarray([1.0, 2.0, 5.0])
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3]
    local = rng.uniform(-0.5, 0.5, (292, 3)) ** 3 * 4 * sides
    corners = trimesh.creation.box(sides).vertices
    points = np.concatenate([local, corners]) @ turn.T + [3, -1, 2]
    cloud = PointCloud(np.pad(points, [(0, 20), (0, 0)]), mask=np.arange(320) < 300)
    plain, small = bounding_box(cloud), jax.jit(oriented_box)(cloud)
    principal = oriented_box(cloud, method=PrincipalAxes())
    np.testing.assert_allclose(
        plain.corners().min(axis=0), points.min(axis=0), rtol=1e-5
    )
    np.testing.assert_allclose(
        plain.corners().max(axis=0), points.max(axis=0), rtol=1e-5
    )
    for box in (plain, small, principal):
        assert box.contains(jnp.asarray(points)).all()
        np.testing.assert_allclose(box.axes.T @ box.axes, np.eye(3), atol=1e-5)
        np.testing.assert_allclose(jnp.linalg.det(box.axes), 1, atol=1e-5)
        assert not box.contains(box.center + 1.01 * (box.corners() - box.center)).any()
    np.testing.assert_allclose(small.volume, 10, rtol=2e-3)
    assert small.volume < principal.volume < plain.volume
    peer = trimesh.bounds.oriented_bounds(points)[1].prod()
    assert small.volume < 1.01 * peer
    outside = crop(cloud, lambda p: jnp.linalg.norm(p - jnp.asarray([3, -1, 2])) - 0.5)
    near = np.linalg.norm(points - [3, -1, 2], axis=1) <= 0.5
    np.testing.assert_array_equal(outside.mask[:300], near)
    test = crop(cloud, lambda p: p[0] > 3)
    np.testing.assert_array_equal(test.mask[:300], points[:, 0].astype("f4") > 3)
    half = eqx_half(plain)
    assert 0 < int(crop(cloud, half).num_points) < 300
    assert isinstance(MinimalVolume(), MinimalVolume)


def eqx_half(box):
    """The box of half the size."""
    return type(box)(box.center, box.axes, box.half_extents / 2)


def test_merging_moves_points_and_normals():
    cloud = _cloud()
    turn = Rigid.exp(jnp.asarray([0.3, -0.2, 0.5, 1.0, 2.0, 3.0]))
    both = merge([cloud, cloud], [lambda c: c, turn])
    assert int(both.num_points) == 600 and both.points.shape[0] == 640
    np.testing.assert_allclose(
        both.points[320:620], turn(cloud.points[:300]), atol=1e-5
    )
    np.testing.assert_allclose(
        both.normals[320:620], turn(cloud).normals[:300], atol=1e-5
    )
    np.testing.assert_array_equal(
        both.attributes["colors"][:300], both.attributes["colors"][320:620]
    )
    with pytest.raises(GeometryError, match="same normals and attributes"):
        merge([cloud, PointCloud(cloud.points)])
    with pytest.raises(GeometryError, match="one transform"):
        merge([cloud], [])
    with pytest.raises(GeometryError, match="at least one cloud"):
        merge([])


@pytest.mark.slow
def test_padding_and_batches():
    cloud, bare = _cloud(), _cloud(0)
    pair = jax.tree.map(lambda *x: jnp.stack(x), cloud, turned(cloud))
    batch = jax.vmap(lambda c: voxel_downsample(c, SIZE).cloud.points)(pair)
    alone = voxel_downsample(turned(cloud), SIZE).cloud.points
    np.testing.assert_allclose(batch[1], alone, atol=1e-6)
    a, b = (voxel_downsample(x, SIZE).cloud.trim() for x in (cloud, bare))
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(statistical(cloud)[:300], statistical(bare))


def turned(cloud):
    """The cloud with its axes exchanged."""
    return PointCloud(
        np.asarray(cloud.points)[:, [2, 0, 1]],
        np.asarray(cloud.normals)[:, [2, 0, 1]],
        cloud.mask,
        cloud.attributes,
    )
