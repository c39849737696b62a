"""Alignment by closest points: laws, statuses, composition."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from jaxgeom import Affine, PointCloud, Rigid, Similarity, TriangleMesh
from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.meshes import icosphere
from jaxgeom.neighbors import BruteForce, HostTree
from jaxgeom.normals import estimate
from jaxgeom.registration import (
    L2,
    AffineModel,
    Alternation,
    Anderson,
    ClosestSurface,
    DistanceField,
    Facing,
    GaussianPrior,
    GaussNewton,
    Generalized,
    LeastSquares,
    LevenbergMarquardt,
    Method,
    Minimise,
    Mutual,
    Nearest,
    PointToPlane,
    PointToPoint,
    PointToSurface,
    Reciprocal,
    RigidModel,
    SimilarityModel,
    Symmetric,
    Trimmed,
    Tukey,
    icp,
    prepare_target,
    translation_only,
    yaw,
)

N, M, CAPACITY = 200, 900, 256
GATE = 0.4
MOVE = np.array([0.06, -0.09, 0.05, 0.05, -0.04, 0.03])


def _surface(n, seed):
    """Points of a bumpy ellipsoid off the origin, with the normals of its bumps.

    Normals of the plain ellipsoid would leave affine maps of it to itself free.
    """
    rng = np.random.default_rng(seed)
    x = rng.normal(size=(n, 3))
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    axes = np.array([1.0, 0.7, 0.5])
    a, b = 3 * x[:, 0], 2 * x[:, 1]
    bump = 1 + 0.1 * np.sin(a) * np.cos(b)
    points = x * axes * bump[:, None] + [0.4, -0.3, 0.8]
    # The surface is |u| = bump(u / |u|) with u = point / axes.
    slope = 0.1 * np.stack([3 * np.cos(a) * np.cos(b), -2 * np.sin(a) * np.sin(b)], 1)
    slope = np.pad(slope, ((0, 0), (0, 1)))
    slope = slope - np.sum(slope * x, axis=1, keepdims=True) * x
    normals = (x - slope / bump[:, None]) / axes
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return points, normals


def _padded(points, normals, dtype=np.float32, capacity=CAPACITY):
    pad = lambda x: np.pad(x, ((0, capacity - len(x)), (0, 0))).astype(dtype)
    return PointCloud(pad(points), pad(normals), np.arange(capacity) < len(points))


@functools.lru_cache
def _pair(dtype=np.float32):
    """A source that is part of the target, moved back by a known motion."""
    points, normals = _surface(M, 1)
    target = PointCloud(points.astype(dtype), normals.astype(dtype))
    back = Rigid.exp(jnp.asarray(MOVE)).inverse()
    some = slice(0, N)
    noise = 0.002 * np.random.default_rng(2).normal(size=(N, 3))
    source = back(points[some] + noise), back.normals(normals[some])
    return _padded(*map(np.asarray, source), dtype), target


def _method(**parts):
    """A method whose search compiles in no time."""
    return Method(correspondence=Nearest(backend=BruteForce()), **parts)


@eqx.filter_jit
def align(source, target, **settings):
    usual = {"method": _method(), "max_distance": GATE, "max_steps": 40}
    return icp(source, target, **(usual | settings))


def _off(found, move=MOVE):
    truth = Rigid.exp(jnp.asarray(move)).matrix()
    return np.abs(np.asarray(found.target_from_source.matrix()) - truth).max()


def test_a_target_gets_its_normals_by_its_own_index():
    source, target = _pair()
    bare = PointCloud(target.points)
    prepared = prepare_target(bare, Nearest(backend=BruteForce()))
    found = estimate(prepared.cloud, k=12, index=prepared.index).normals
    want = estimate(bare, k=12, backend=BruteForce()).normals
    cosine = np.abs(np.sum(np.asarray(found) * np.asarray(want), axis=1))
    assert cosine.min() > 1 - 1e-5
    first = align(source, prepared.with_normals(found))
    second = align(source, bare.with_normals(want))
    assert first.result == second.result == RESULTS.successful
    assert _off(first) < 0.01
    np.testing.assert_allclose(
        first.target_from_source.matrix(),
        second.target_from_source.matrix(),
        atol=2e-5,
    )
    with pytest.raises(GeometryError, match="an index must be that of the points"):
        estimate(source, k=12, index=prepared.index)
    with pytest.raises(GeometryError, match="only a cloud as target"):
        _ = prepare_target(icosphere(1), ClosestSurface()).index


SOLVERS = [
    Method(),
    _method(objective=Symmetric()),
]
# Each composition is a program of its own, and takes seconds to compile.
MORE_SOLVERS = [
    _method(objective=Generalized()),
    _method(solver=LeastSquares(optx.Dogleg(rtol=1e-6, atol=1e-6))),
    _method(solver=LevenbergMarquardt()),
    _method(objective=PointToPoint(), solver=Alternation()),
    _method(solver=LeastSquares(optx.GaussNewton(rtol=1e-6, atol=1e-6))),
    _method(solver=Minimise(optx.BFGS(rtol=1e-6, atol=1e-6))),
    Method(correspondence=Mutual()),
    Method(correspondence=Reciprocal(0.05)),
    Method(correspondence=Nearest(Facing(0.8))),
    _method(kernel=Trimmed(0.8)),
    _method(solver=Anderson(GaussNewton())),
    Method(correspondence=Nearest(backend=HostTree())),
    _method(model=SimilarityModel()),
]
SOLVERS += [pytest.param(m, marks=pytest.mark.slow) for m in MORE_SOLVERS]


@pytest.mark.parametrize("seed", [11, pytest.param(12, marks=pytest.mark.slow)])
def test_pairs_that_alternate_end_the_search(seed):
    """Noise makes these searches go round for ever; all poses of the round will do."""
    points, normals = _surface(N, seed)
    points = points + 0.02 * np.random.default_rng(seed).normal(size=points.shape)
    source, target = _padded(points, normals), _pair()[1]
    method = _method(objective=Symmetric())
    run = lambda rtol: align(source, target, method=method, rtol=jnp.float32(rtol))
    found = run(np.finfo(np.float32).eps ** (2 / 3))
    assert found.result == RESULTS.successful and found.num_steps < 20
    # Without a tolerance it goes on, and never comes to rest nor gets anywhere.
    long = run(-1)
    assert long.result == RESULTS.not_converged
    assert _off(found, Rigid.log(long.target_from_source)) < 1e-3


@pytest.mark.parametrize("method", SOLVERS, ids=lambda m: str(m)[:10])
def test_every_composition_finds_the_motion(method):
    source, target = _pair()
    found = align(source, target, method=method, max_steps=100)
    # To trim a fifth of Gaussian residuals makes the variance 1 / 0.35 times larger.
    loss = 0.35**-0.5 if isinstance(method.kernel, Trimmed) else 1
    assert _off(found) < 2e-3 * loss
    assert int(found.num_matches) >= 0.6 * N
    assert np.linalg.det(found.target_from_source.rotation) > 0


def test_affine_maps_are_found():
    source, target = _pair()
    found = align(source, target, method=_method(model=AffineModel()), max_steps=100)
    assert found.result == RESULTS.successful
    assert isinstance(found.target_from_source, Affine) and _off(found) < 4e-3


def test_scale_is_found():
    source, target = _pair()
    shrink = Similarity(jnp.asarray(1.05), jnp.eye(3), jnp.zeros(3))
    small = shrink.inverse()(source)
    method = _method(objective=PointToPoint(), model=SimilarityModel())
    found = align(small, target, method=method, max_steps=100)
    assert abs(float(found.target_from_source.scale) - 1.05) < 3e-3


def test_laws_of_one_alignment():
    source, target = _pair()
    found = align(source, target)
    assert found.result == RESULTS.successful
    base = found.target_from_source.matrix()
    # The order of the points.
    order = np.random.default_rng(3).permutation(CAPACITY)
    shuffled = align(jax.tree.map(lambda x: x[order], source), target)
    np.testing.assert_allclose(shuffled.target_from_source.matrix(), base, atol=2e-6)
    # Padding, whatever it holds; and again the same, bit for bit.
    for fill in (7.0, np.nan):
        points = np.where(source.mask[:, None], source.points, np.float32(fill))
        again = align(PointCloud(points, source.normals, source.mask), target)
        np.testing.assert_array_equal(again.target_from_source.matrix(), base)
        assert again.num_steps == found.num_steps
    # Points that are not finite are points removed.
    hurt = source.points.copy()
    hurt[5] = np.nan
    gone = source.mask & (np.arange(CAPACITY) != 5)
    a = align(PointCloud(hurt, source.normals, source.mask), target)
    b = align(PointCloud(source.points, source.normals, gone), target)
    np.testing.assert_array_equal(
        a.target_from_source.matrix(), b.target_from_source.matrix()
    )
    assert a.num_matches == b.num_matches == found.num_matches - 1


def test_common_motions_and_units():
    source, target = _pair()
    found = align(source, target)
    move = Rigid.exp(jnp.asarray([0.7, -0.4, 1.1, 2.0, -3.0, 1.0]))
    both = align(move(source), move(target))
    expected = move @ found.target_from_source @ move.inverse()
    np.testing.assert_allclose(
        both.target_from_source.matrix(), expected.matrix(), atol=2e-5
    )
    unit = lambda c: PointCloud(c.points * 1024, c.normals, c.mask)
    large = align(unit(source), unit(target), max_distance=1024 * GATE)
    np.testing.assert_allclose(
        large.target_from_source.rotation,
        found.target_from_source.rotation,
        atol=1e-6,
    )
    np.testing.assert_allclose(
        large.target_from_source.translation,
        1024 * found.target_from_source.translation,
        rtol=1e-4,
        atol=1e-3,
    )
    assert large.num_steps == found.num_steps


def test_batches_are_loops(x64):
    # In double precision no step is as short as rtol by rounding alone.
    source, target = _pair(np.float64)
    hopeless = PointCloud(source.points + 50, source.normals, source.mask)
    few = PointCloud(source.points, source.normals, np.arange(CAPACITY) < 4)
    sources = [source, hopeless, few]
    stacked = jax.tree.map(lambda *x: np.stack(x), *sources)
    together = eqx.filter_jit(jax.vmap(lambda s: align(s, target)))(stacked)
    for i, one in enumerate(sources):
        alone = align(one, target)
        row = jax.tree.map(lambda x, i=i: x[i], together)
        assert row.result == alone.result
        assert row.num_steps == alone.num_steps
        assert row.num_matches == alone.num_matches
        np.testing.assert_allclose(
            row.target_from_source.matrix(),
            alone.target_from_source.matrix(),
            atol=2e-6,
        )


def test_statuses():
    source, target = _pair()
    far = PointCloud(source.points + 50, source.normals, source.mask)
    lost = align(far, target)
    assert lost.result == RESULTS.no_overlap and lost.fitness == 0
    assert np.all(np.isfinite(lost.target_from_source.matrix()))
    few = PointCloud(source.points, source.normals, np.arange(CAPACITY) < 4)
    assert align(few, target).result == RESULTS.too_few_points
    mixed = source.points.copy()
    mixed[4:] += 50
    scattered = PointCloud(mixed, source.normals, source.mask)
    assert align(scattered, target, max_distance=3.0).result == RESULTS.too_few_matches
    assert align(source, target, max_steps=2).result == RESULTS.not_converged
    assert align(source, target).result == RESULTS.successful


class _Idle(optx.AbstractMinimiser):
    """A minimiser that gives up where it starts."""

    rtol: float = 0.0
    atol: float = 0.0
    norm: object = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        return jnp.zeros((), bool)

    def step(self, fn, y, args, options, state, tags):
        return y, state, fn(y, args)[1]

    def terminate(self, fn, y, args, options, state, tags):
        return jnp.asarray(False), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


@pytest.mark.slow
def test_a_solver_without_a_way_down_is_a_status():
    source, target = _pair()
    method = _method(solver=Minimise(_Idle()))
    stuck = align(source, target, method=method, max_steps=4)
    assert stuck.result == RESULTS.not_converged and stuck.num_steps == 4
    # At the minimum there is no way down, and nothing to complain of.
    best = align(source, target).target_from_source
    there = align(source, target, method=method, init=best)
    assert there.result == RESULTS.successful


def test_mixing_takes_fewer_steps_to_the_same_place(x64):
    # On a smooth surface the alternation slides slowly, every step a bit shorter.
    axes = jnp.asarray([1.0, 0.7, 0.5])
    body = lambda p: jnp.linalg.norm(p / axes) - 1
    x = np.random.default_rng(9).normal(size=(N, 3))
    x = x / np.linalg.norm(x, axis=1, keepdims=True) * axes
    source = PointCloud(Rigid.exp(jnp.asarray(3 * MOVE)).inverse()(x))
    parts = dict(correspondence=DistanceField(), objective=PointToPoint(), kernel=L2())
    solve = lambda solver: eqx.filter_jit(icp)(
        source, body, method=Method(solver=solver, **parts), max_steps=400, rtol=1e-8
    )
    plain, mixed = solve(Alternation()), solve(Anderson())
    assert mixed.result == plain.result == RESULTS.successful
    assert mixed.num_steps < 0.4 * plain.num_steps
    assert _off(plain, 3 * MOVE) < 1e-6 and _off(mixed, 3 * MOVE) < 1e-6


@pytest.mark.slow
def test_pairs_that_are_kept_are_those_of_a_new_search():
    rng = np.random.default_rng(7)
    source, target = _pair()
    rule = Nearest()
    match = jax.jit(lambda moved, last: rule.match(index, moved, 0.3, last))
    anew = jax.jit(lambda moved: rule.match(index, moved, 0.3))
    index = rule.prepare(target)
    found = anew(source)
    for size in (0.1, 0.03, 0.01, 0.003, 0.001, 0.0003):
        source = Rigid.exp(jnp.asarray(size * rng.normal(size=6), np.float32))(source)
        found, true = match(source, found), anew(source)
        np.testing.assert_array_equal(found.mask, true.mask)
        np.testing.assert_array_equal(found.indices, true.indices)
    still = jnp.all(found.memory.points == source.points, axis=1)
    assert np.mean(still) < 0.2 and np.any(found.mask) and not np.all(found.mask)


def test_planes_and_lines_are_degenerate():
    rng = np.random.default_rng(4)
    flat = rng.uniform(-1, 1, (M, 3)) * [1, 1, 0]
    up = np.broadcast_to([0.0, 0.0, 1.0], (M, 3))
    plane = PointCloud(flat.astype(np.float32), up.astype(np.float32))
    lifted = _padded(flat[:N] + [0, 0, 0.05], up[:N])
    found = align(lifted, plane)
    assert found.result == RESULTS.degenerate_input
    values = np.asarray(found.degeneracy.eigenvalues)
    assert np.sum(values < 1e-4 * values[-1]) == 3
    # The undetermined moves: a turn about z, shifts along x and y.
    loose = np.asarray(found.degeneracy.directions)[:3]
    assert np.abs(loose[:, [0, 1, 5]]).max() < 1e-3
    np.testing.assert_allclose(
        found.target_from_source.translation[2], -0.05, atol=1e-5
    )
    line = rng.uniform(-1, 1, (M, 1)) * [1.0, 0.0, 0.0]
    rod = PointCloud(line.astype(np.float32), up.astype(np.float32))
    points = _method(objective=PointToPoint())
    found = align(_padded(line[:N], up[:N]), rod, method=points)
    assert found.result == RESULTS.degenerate_input


@pytest.mark.slow
def test_locked_directions_and_prior():
    source, target = _pair()
    shift = align(source, target, method=_method(model=RigidModel(translation_only())))
    np.testing.assert_allclose(shift.target_from_source.rotation, np.eye(3), atol=1e-6)
    axis = np.array([0.0, 0.0, 1.0])
    turn = align(source, target, method=_method(model=RigidModel(yaw(axis))))
    np.testing.assert_allclose(turn.target_from_source.rotation @ axis, axis, atol=1e-6)
    assert not np.allclose(turn.target_from_source.rotation, np.eye(3), atol=1e-3)
    mean = Rigid.exp(jnp.asarray([0.0, 0.0, 0.0, 0.02, 0.0, 0.0]))
    strong = GaussianPrior(mean, 1e-8 * jnp.eye(6), 1.0)
    held = align(source, target, method=_method(model=RigidModel(prior=strong)))
    np.testing.assert_allclose(
        held.target_from_source.matrix(), mean.matrix(), atol=1e-4
    )


def test_surfaces_and_fields():
    ball = icosphere(3)
    rng = np.random.default_rng(5)
    stretch = np.array([1.0, 0.7, 0.5])
    vertices = jnp.asarray(ball.vertices * stretch, jnp.float32)
    mesh = TriangleMesh(vertices, jnp.asarray(ball.faces))
    corners = np.asarray(mesh.triangles())[rng.integers(0, len(ball.faces), N)]
    shares = rng.dirichlet(np.ones(3), N)
    points = np.einsum("ni,nid->nd", shares, corners)
    back = Rigid.exp(jnp.asarray(MOVE)).inverse()
    source = _padded(np.asarray(back(points)), np.zeros((N, 3)))
    bare = PointCloud(source.points, None, source.mask)
    surface = Method(correspondence=ClosestSurface(), objective=PointToSurface())
    found = align(bare, mesh, method=surface)
    assert found.result == RESULTS.successful and _off(found) < 1e-4
    field = lambda x: jnp.sum((x / jnp.asarray(stretch)) ** 2) - 1
    on = points / np.linalg.norm(points / stretch, axis=1, keepdims=True)
    source = _padded(np.asarray(back(on)), np.zeros((N, 3)))
    level = Method(correspondence=DistanceField(), objective=PointToSurface())
    found = align(PointCloud(source.points, None, source.mask), field, method=level)
    assert found.result == RESULTS.successful and _off(found) < 1e-4


def test_history_falls_and_one_trace_serves_a_bucket():
    source, target = _pair()
    method = _method(
        kernel=Tukey(0.3), objective=PointToPlane(), solver=LevenbergMarquardt()
    )
    found = align(source, target, method=method, history=True)
    costs = np.asarray(found.history)
    real = costs[np.isfinite(costs)]
    assert len(real) == found.num_steps - 1 and real[-1] < 0.1 * real[0]
    traces = []

    @jax.jit
    def counted(source):
        traces.append(1)
        return align(source, target).rmse

    for n in (100, 150, 200):
        counted(PointCloud(source.points, source.normals, np.arange(CAPACITY) < n))
    assert len(traces) == 1


def test_clear_errors():
    source, target = _pair()
    bare = PointCloud(source.points, None, source.mask)
    with pytest.raises(GeometryError, match="needs normals of the source"):
        icp(bare, target, method=_method(objective=Symmetric()))
    with pytest.raises(GeometryError, match="Alternation fits points"):
        icp(source, target, method=_method(solver=Alternation()))
    with pytest.raises(GeometryError, match="needs a TriangleMesh"):
        icp(source, target, method=Method(correspondence=ClosestSurface()))
