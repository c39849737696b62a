"""Exact neighbors on easy and nasty data, against scipy; gradients, masks, vmap."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.neighbors import (
    BruteForce,
    CandidateLists,
    HostTree,
    KdTree,
    build,
    kd_groups,
    knn,
)

N, Q = 1200, 300


def _clouds():
    rng = np.random.default_rng(7)
    sphere = rng.normal(size=(N, 3))
    sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
    clusters = np.concatenate(
        [
            rng.normal(0, 1e-3, (N // 3, 3)),
            rng.normal(0, 1, (N // 3, 3)) + 900,
            rng.normal(0, 1e-2, (N // 3, 3)) + 5,
        ]
    )
    plane = rng.uniform(-1, 1, (N, 3)) * [3, 2, 0]
    line = rng.uniform(-1, 1, (N, 3)) * [0, 2, 0]
    return {
        "surface": (2.3 * sphere + [4, -1, 9], 2.1 * sphere[:Q] + [4, -1, 9.1]),
        "volume": (rng.uniform(-2, 5, (N, 3)), rng.uniform(-3, 6, (Q, 3))),
        "clusters": (clusters, clusters[::4] + 1e-4),
        "plane": (plane, rng.uniform(-1, 1, (Q, 3))),
        "line": (line, rng.uniform(-1, 1, (Q, 3))),
        "duplicates": (np.repeat(sphere[:10], N // 10, axis=0), sphere[:Q]),
        "one place": (np.full((N, 3), 2.5), sphere[:Q]),
        "far apart": (
            np.concatenate([sphere[:-1], [[3e5, -2e5, 1e5]]]),
            2 * sphere[:Q],
        ),
        "far queries": (sphere, 1e4 * sphere[:Q] + 3e4),
    }


CLOUDS = _clouds()


def _assert_exact(points, queries, k, out):
    points, queries = (np.asarray(x, np.float32) for x in (points, queries))
    want = cKDTree(points.astype(float)).query(queries.astype(float), k)[0]
    np.testing.assert_allclose(
        np.asarray(out.distances), want.reshape(-1, k), rtol=2e-6, atol=1e-7
    )
    there = points[np.asarray(out.indices)] - queries[:, None]
    np.testing.assert_allclose(np.linalg.norm(there, axis=-1), out.distances, rtol=2e-6)
    assert np.asarray(out.mask).all()
    rows = np.sort(np.asarray(out.indices), axis=1)
    assert k == 1 or (np.diff(rows, axis=1) > 0).all()


@pytest.mark.parametrize("name", CLOUDS)
@pytest.mark.parametrize("backend", [KdTree(), BruteForce(tile=64), HostTree()])
def test_equals_a_tree(name, backend):
    points, queries = (jnp.asarray(x, jnp.float32) for x in CLOUDS[name])
    find = jax.jit(lambda p, q: knn(build(p, backend=backend), q, 5))
    _assert_exact(points, queries, 5, find(points, queries))


# Every cloud makes a program of its own.
_SOME = ("clusters", "duplicates", "far queries")
_REST = [pytest.param(x, marks=pytest.mark.slow) for x in CLOUDS if x not in _SOME]


@pytest.mark.parametrize("name", [*_SOME, *_REST])
def test_lists_equal_a_tree(name):
    """On the points, a little beside them (a few rows in doubt), and elsewhere."""
    points, queries = (jnp.asarray(x, jnp.float32) for x in CLOUDS[name])
    rng = np.random.default_rng(3)
    size = 0.02 * jnp.max(jnp.ptp(points, axis=0))
    beside = points[:Q] + size * rng.normal(size=(Q, 3)).astype(np.float32)
    index = build(points, backend=CandidateLists())
    find = jax.jit(lambda q: knn(index, q, 2))
    for asked in (points[-Q:], beside, queries):
        _assert_exact(points, asked, 2, find(asked))


@pytest.mark.parametrize("scale", [1e-15, pytest.param(1e15, marks=pytest.mark.slow)])
def test_lists_of_tiny_and_huge_shapes(scale):
    """The cube of their extent is no number in single precision."""
    points = jnp.asarray(scale * CLOUDS["surface"][0][:300], jnp.float32)
    found = knn(build(points, backend=CandidateLists()), points, 1)
    assert (found.indices[:, 0] == jnp.arange(300)).all()


def test_lists_decide_most_queries_near_the_points():
    points = jnp.asarray(CLOUDS["surface"][0], jnp.float32)
    index = build(points, backend=CandidateLists())
    beside = points + 0.02 * np.random.default_rng(3).normal(size=(N, 3))
    certain = index.from_lists(
        beside.astype(jnp.float32), 2, jnp.float32(jnp.inf)
    ).certain
    assert certain.mean() > 0.9
    # Far away only the gate decides: nothing can be within it.
    far = points[:Q] + 100
    assert not index.from_lists(far, 2, jnp.float32(jnp.inf)).certain.any()


def test_large_clouds_are_searched_in_wide_steps():
    rng = np.random.default_rng(8)
    points, queries = (rng.normal(size=(n, 3)) for n in (24_000, Q))
    points, queries = (jnp.asarray(x, jnp.float32) for x in (points, queries))
    find = jax.jit(lambda p, q: knn(build(p), q, 2))
    _assert_exact(points, queries, 2, find(points, queries))


@pytest.mark.slow
@pytest.mark.parametrize("k", [1, pytest.param(64, marks=pytest.mark.slow)])
def test_other_counts_of_neighbors(k):
    points, queries = (jnp.asarray(x, jnp.float32) for x in CLOUDS["surface"])
    _assert_exact(
        points, queries, k, jax.jit(lambda p, q: knn(build(p), q, k))(points, queries)
    )


@pytest.mark.parametrize(
    "backend", [KdTree(), BruteForce(), CandidateLists(), HostTree()]
)
def test_padding_and_missing_neighbors(backend):
    points, queries = CLOUDS["volume"]
    points, queries = jnp.asarray(points[:40]), jnp.asarray(queries[:9])
    mask = jnp.arange(40) < 3
    points = jnp.where(mask[:, None], points, jnp.nan)
    asked = jnp.arange(9) != 4
    out = knn(build(points, mask, backend=backend), queries, 5, mask=asked)
    assert (out.mask == asked[:, None] & (jnp.arange(5) < 3)).all()
    assert ((out.indices == 40) == ~out.mask).all()
    assert (jnp.isinf(out.distances) == ~out.mask).all()
    assert bool(out.result == RESULTS.too_few_points)


@pytest.mark.parametrize(
    "backend", [KdTree(), BruteForce(), CandidateLists(), HostTree()]
)
def test_max_distance_is_a_gate(backend):
    points, queries = (jnp.asarray(x, jnp.float32) for x in CLOUDS["volume"])
    gate = 0.8
    free = knn(build(points, backend=backend), queries, 6)
    gated = knn(build(points, backend=backend), queries, 6, max_distance=gate)
    inside = free.distances <= gate
    assert 0.1 < inside.mean() < 0.9
    assert (gated.mask == inside).all()
    assert (gated.distances == jnp.where(inside, free.distances, jnp.inf)).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "backend", [KdTree(), BruteForce(), CandidateLists(), HostTree(workers=1)]
)
def test_vmap_is_a_loop(backend):
    names = ["surface", "volume", "plane"]
    points = jnp.asarray(np.stack([CLOUDS[n][0][:500] for n in names]), jnp.float32)
    queries = jnp.asarray(np.stack([CLOUDS[n][1][:70] for n in names]), jnp.float32)
    find = lambda p, q: knn(build(p, backend=backend), q, 3).distances
    batch = jax.jit(jax.vmap(find))(points, queries)
    alone = jnp.stack([find(p, q) for p, q in zip(points, queries, strict=True)])
    np.testing.assert_allclose(batch, alone, rtol=1e-6)


@pytest.mark.parametrize("name", ["surface", "clusters", "one place", "far apart"])
def test_groups_lie_together(name):
    """Every real row once, padding last, and compact."""
    points = jnp.asarray(CLOUDS[name][0][:500], jnp.float32)
    mask = jnp.arange(500) % 7 > 0
    groups = np.asarray(jax.jit(kd_groups, static_argnums=2)(points, mask, 8))
    count, size = groups.shape
    assert size <= 8 and count & (count - 1) == 0
    rows = groups.reshape(-1)
    real = rows < 500
    assert not np.any(~real[:-1] & real[1:])
    np.testing.assert_array_equal(np.sort(rows[real]), np.flatnonzero(mask))
    if name == "surface":
        full = groups[np.all(groups < 500, axis=1)]
        widths = np.ptp(np.asarray(points)[full], axis=1).max(axis=1)
        # Square patches of a sphere of radius 2.3, as many as there are groups of 8.
        side = np.sqrt(4 * np.pi * 2.3**2 / (mask.sum() / 8))
        assert widths.mean() < 1.2 * side


@pytest.mark.parametrize("k", [2, 5])
def test_known_groups_and_few_queries_change_nothing(k):
    """All queries, hundreds and a handful of them: packets of other sizes."""
    points, _ = CLOUDS["surface"]
    points = jnp.asarray(points, jnp.float32)
    index = build(points)
    find = jax.jit(lambda mask, groups: knn(index, points, k, mask=mask, groups=groups))
    free = find(jnp.ones(N, bool), None)
    _assert_exact(points, points, k, free)
    number = np.random.default_rng(4).permutation(N)
    for some in (N, 700, 300, 9, 0):
        mask = jnp.asarray(number < some)
        for groups in (None, index.groups):
            found = find(mask, groups)
            assert (found.mask == mask[:, None]).all()
            np.testing.assert_array_equal(
                found.indices, jnp.where(mask[:, None], free.indices, N)
            )


@pytest.mark.parametrize(
    "backend", [KdTree(), BruteForce(), CandidateLists(), HostTree()]
)
def test_every_query_has_a_gate_of_its_own(backend):
    points, queries = (jnp.asarray(x, jnp.float32) for x in CLOUDS["volume"])
    index = build(points, backend=backend)
    free = knn(index, queries, 2)
    # Just beyond the first, the second, none, and all.
    gate = jnp.stack([1.0001 * free.distances[:, 0], 1.0001 * free.distances[:, 1]])
    gate = jnp.concatenate([gate, jnp.full((1, Q), -1.0), jnp.full((1, Q), jnp.inf)])
    gate = gate[jnp.arange(Q) % 4, jnp.arange(Q)]
    found = knn(index, queries, 2, max_distance=gate)
    np.testing.assert_array_equal(found.mask, free.distances <= gate[:, None])
    np.testing.assert_array_equal(found.indices, jnp.where(found.mask, free.indices, N))


def test_gradients(x64):
    points, queries = (jnp.asarray(x[:60]) for x in CLOUDS["volume"])
    queries = queries[:20]
    loss = lambda p, q: jnp.sum(jnp.sin(knn(build(p), q, 3).distances))
    slopes = jax.jit(jax.grad(loss, argnums=(0, 1)))(points, queries)
    ways = jax.random.normal(jax.random.key(3), (80, 3))
    step = lambda h: loss(points + h * ways[:60], queries + h * ways[60:])
    numeric = (step(1e-6) - step(-1e-6)) / 2e-6
    given = jnp.sum(slopes[0] * ways[:60]) + jnp.sum(slopes[1] * ways[60:])
    np.testing.assert_allclose(given, numeric, rtol=1e-6)
    zero = jax.grad(loss, argnums=1)(points, points[:20])
    assert jnp.isfinite(zero).all()


@pytest.mark.slow
def test_padding_has_no_gradient():
    points = jnp.asarray(CLOUDS["volume"][0][:30], jnp.float32)
    mask = jnp.arange(30) % 3 > 0
    loss = lambda p: jnp.where(
        (o := knn(build(p, mask), p, 25)).mask, o.distances, 0
    ).sum()
    slope = jax.grad(loss)(points)
    assert jnp.isfinite(slope).all()


def test_wrong_input_is_explained():
    points = jnp.zeros((5, 3))
    with pytest.raises(GeometryError, match="k must be at least 1"):
        knn(build(points), points, 0)
    with pytest.raises(GeometryError, match="queries must have shape"):
        knn(build(points), points[0], 1)
    with pytest.raises(GeometryError, match="room for at least one"):
        build(jnp.zeros((0, 3)))
