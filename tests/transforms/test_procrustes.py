"""Procrustes: the optimum against scipy, derivatives, statuses, masks, dimensions."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.transforms import Rigid, Similarity, nearest_rotation, procrustes

N = 8
RNG = np.random.default_rng(11)
CUBE = 1.3 * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
OCTAHEDRON = 0.7 * np.concatenate([np.eye(3), -np.eye(3)])
PLANE = RNG.normal(size=(N, 3)) @ np.diag([2.0, 1.0, 0.0]) + [0.3, -2.0, 0.5]
GENERIC = RNG.normal(size=(N, 3)) * [3.0, 2.0, 1.0] + [5.0, -1.0, 2.0]
LINE = np.linspace(-1, 2, N)[:, None] * [0.3, -1.0, 0.4] + [1.0, 0.2, 7.0]

fit_all = jax.jit(jax.vmap(lambda a, b, w: procrustes(a, b, w)))
scaled_all = jax.jit(jax.vmap(lambda a, b, w: procrustes(a, b, w, scaling=True)))
masked = jax.jit(lambda a, b, w, m: procrustes(a, b, w, mask=m, scaling=True))


def _problems(count, n=20, noise=0.5):
    rng = np.random.default_rng(0)
    source = rng.normal(size=(count, n, 3)) * [3, 2, 1] + rng.normal(size=(count, 1, 3))
    turns = Rotation.random(count, random_state=0).as_matrix()
    target = np.einsum("kij,knj->kni", turns, source) + noise * rng.normal(
        size=source.shape
    )
    return source, target + 4, rng.uniform(0, 1, (count, n)) ** 3


def test_cost_is_that_of_scipy(x64):
    source, target, weights = _problems(200)
    fit = fit_all(source, target, weights)
    assert bool(jnp.all(fit.result == RESULTS.successful))
    for a, b, w, rmse in zip(source, target, weights, fit.rmse, strict=True):
        a, b = a - w @ a / w.sum(), b - w @ b / w.sum()
        best, _ = Rotation.align_vectors(b, a, weights=w)
        cost = w @ np.sum((b - best.apply(a)) ** 2, axis=1)
        np.testing.assert_allclose(rmse**2 * w.sum(), cost, rtol=1e-12)


def test_rmse_is_that_of_the_transform(x64):
    source, target, weights = _problems(5)
    for solve in (fit_all, scaled_all):
        fit = solve(source, target, weights)
        moved = jax.vmap(lambda t, x: t(x))(fit.transform, source)
        square = np.sum(weights * np.sum((moved - target) ** 2, axis=-1), axis=1)
        np.testing.assert_allclose(fit.rmse**2, square / weights.sum(1), rtol=1e-12)


@pytest.mark.slow
def test_scale_is_the_least_squares_one(x64):
    source, target, weights = _problems(5)
    best = scaled_all(source, target, weights)

    def cost(step):
        moved = jax.vmap(lambda t, x: (t @ Similarity.exp(step))(x))(
            best.transform, jnp.asarray(source)
        )
        return jnp.sum(weights * jnp.sum((moved - target) ** 2, axis=-1))

    # All seven directions at once: the optimum is stationary, and a minimum.
    gradient, hessian = jax.jit(
        lambda s: (jax.grad(cost)(s), jax.jacfwd(jax.grad(cost))(s))
    )(jnp.zeros(7))
    size = float(np.abs(hessian).max())
    np.testing.assert_allclose(gradient, 0, atol=1e-13 * size)
    assert np.linalg.eigvalsh((hessian + hessian.T) / 2).min() > 1e-6 * size


@pytest.mark.parametrize("dtype, atol", [(np.float32, 2e-5), (np.float64, 1e-13)])
@pytest.mark.parametrize("dimension", [2, 3, 4, 6])
def test_recovers_the_map_in_any_dimension(dimension, dtype, atol, x64):
    rng = np.random.default_rng(dimension)
    rotation = np.linalg.qr(rng.normal(size=(dimension, dimension)))[0]
    rotation[:, 0] *= np.sign(np.linalg.det(rotation))
    source = rng.normal(size=(15, dimension)).astype(dtype)
    target = (2.5 * source @ rotation.T + 0.7).astype(dtype)
    fit = procrustes(source, target, scaling=True)
    assert fit.transform.rotation.dtype == dtype and fit.rmse.dtype == dtype
    np.testing.assert_allclose(fit.transform.rotation, rotation, atol=atol)
    np.testing.assert_allclose(fit.transform.scale, 2.5, rtol=atol)
    np.testing.assert_allclose(fit.transform(source), target, atol=20 * atol)
    assert fit.transform.matrix().shape == (dimension + 1, dimension + 1)
    assert fit.result == RESULTS.successful


SHAPES = {"cube": CUBE, "octahedron": OCTAHEDRON, "plane": PLANE, "generic": GENERIC}


PROBE = RNG.normal(size=(4, 3))
STEP = 1e-5


def _loss(x, scaling):
    a, b, w = x[: 3 * N], x[3 * N : 6 * N], x[6 * N :]
    fit = procrustes(a.reshape(N, 3), b.reshape(N, 3), w, scaling=scaling)
    return jnp.sum(fit.transform(jnp.asarray(PROBE)) ** 2 * jnp.arange(1.0, 4))


def _central(function, x, direction):
    """A fourth-order difference: the second-order one is 1e-8 off here."""
    at = lambda k: function(x + k * STEP * direction)
    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * STEP)


@partial(jax.jit, static_argnums=1)
def _derivatives(x, scaling):
    loss = lambda x: _loss(x, scaling)
    direction = jnp.sin(jnp.arange(x.size))
    return (
        jax.grad(loss)(x),
        jax.lax.map(lambda e: jax.jvp(loss, (x,), (e,))[1], jnp.eye(x.size)),
        jax.lax.map(lambda e: _central(loss, x, e), jnp.eye(x.size)),
        jax.jvp(jax.grad(loss), (x,), (direction,))[1],
        _central(jax.grad(loss), x, direction),
    )


@pytest.mark.parametrize("scaling", [False, True])
@pytest.mark.parametrize("name", SHAPES)
def test_derivatives_are_central_differences(name, scaling, x64):
    points = SHAPES[name]
    weights = np.linspace(1, 2, N) if name == "generic" else np.ones(len(points))
    pad = lambda x: np.concatenate([x, np.zeros((N - len(x), *x.shape[1:]))])
    points, weights = pad(points), pad(weights)
    source = points @ Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    x = jnp.asarray(np.concatenate([source.ravel(), points.ravel(), weights]))
    reverse, forward, central, curvature, curved = _derivatives(x, scaling)
    size, bend = float(np.abs(central).max()), float(np.abs(curved).max())
    assert size > 0.1 and bend > 0.1
    np.testing.assert_allclose(reverse, forward, atol=1e-12 * size)
    np.testing.assert_allclose(reverse, central, atol=2e-9 * size)
    np.testing.assert_allclose(curvature, curved, atol=1e-8 * bend)


@jax.jit
def _fit_and_slope(a, b):
    image = lambda a, b: jnp.sum(procrustes(a, b, scaling=True).transform(a[::-1]))
    fit = procrustes(a, b, scaling=True)
    return fit, jax.grad(image, argnums=(0, 1))(a, b)


@pytest.mark.parametrize("offset", [0.0, 300.0])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_degenerate_points_are_a_status_with_finite_derivatives(dtype, offset, x64):
    line = (LINE + offset).astype(dtype)
    generic = GENERIC.astype(dtype)
    point = np.broadcast_to(line[:1], line.shape)
    for a, b in [(line, line), (line, generic), (generic, line), (point, generic)]:
        fit, slope = _fit_and_slope(a, b)
        assert fit.result == RESULTS.degenerate_input
        for leaf in jax.tree.leaves((fit.transform, fit.rmse, slope)):
            assert np.isfinite(leaf).all()
        rotation = np.asarray(fit.transform.rotation, float)
        np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-5)
    fit, _ = _fit_and_slope(generic + dtype(offset), generic)
    assert fit.result == RESULTS.successful


@pytest.mark.parametrize("dimension", [2, 3, 4])
def test_too_few_points_are_a_status(dimension):
    points = RNG.normal(size=(6, dimension)).astype(np.float32)
    solve = jax.jit(lambda m: procrustes(points, 2 * points, mask=m))
    for count in range(dimension):
        fit = solve(np.arange(6) < count)
        assert fit.result == RESULTS.too_few_points
        assert all(np.isfinite(x).all() for x in jax.tree.leaves(fit.transform))
    assert solve(np.arange(6) < dimension).result == RESULTS.successful
    weights = np.where(np.arange(6) < dimension - 1, 0.3, 0)
    fit = procrustes(points, points, weights)
    assert fit.result == RESULTS.too_few_points


CLOUDS = {"random": GENERIC, "planar": PLANE, "cube": CUBE}


@pytest.mark.parametrize("name", CLOUDS)
def test_a_reflection_comes_only_when_asked_for(name, x64):
    source = CLOUDS[name] * [1.0, 0.8, 1.7]
    mirrored = source * [1.0, -1.0, 1.0] @ Rotation.random(random_state=3).as_matrix()
    for target in (source, mirrored, GENERIC[::-1]):
        fit = procrustes(source, target)
        np.testing.assert_allclose(np.linalg.det(fit.transform.rotation), 1, atol=1e-12)
    fit = procrustes(source, mirrored, reflection=True)
    np.testing.assert_allclose(fit.transform(source), mirrored, atol=1e-12)
    # The mirror image of flat points is reached by turning: no reason to reflect.
    expected = 1 if name == "planar" else -1
    np.testing.assert_allclose(np.linalg.det(fit.transform.rotation), expected)
    fit = procrustes(source, source, reflection=True)
    np.testing.assert_allclose(fit.transform.rotation, np.eye(3), atol=1e-12)


@pytest.mark.slow
def test_masked_rows_are_as_if_removed():
    source, target, weights = (x[0].astype(np.float32) for x in _problems(1))
    expected = procrustes(source, target, weights, scaling=True)
    pad = lambda x, fill: np.concatenate([x, np.full((5, *x.shape[1:]), fill, x.dtype)])
    mask = np.arange(25) < 20
    for fill in (0, 1e30, np.nan):
        rows = pad(source, fill), pad(target, fill), pad(weights, fill)
        fit = masked(*rows, mask)
        for a, b in zip(*map(jax.tree.leaves, (expected, fit)), strict=True):
            np.testing.assert_allclose(a, b, rtol=2e-6, atol=2e-6)
        gradients = jax.grad(
            lambda a, b, w: jnp.sum(masked(a, b, w, mask).transform.matrix() ** 2),
            argnums=(0, 1, 2),
        )(*rows)
        for gradient in gradients:
            assert np.isfinite(gradient).all() and not np.any(gradient[20:])
    # Rows that are not finite need no mask.
    fit = masked(pad(source, np.nan), pad(target, 0), pad(weights, 1), mask | True)
    np.testing.assert_allclose(fit.rmse, expected.rmse, rtol=1e-6)


def test_order_of_rows_units_and_motions_do_not_matter(x64):
    source, target, weights = (x[0] for x in _problems(1))
    fit = procrustes(source, target, weights)
    shuffle = RNG.permutation(20)
    other = procrustes(source[shuffle], target[shuffle], 1e-200 * weights[shuffle])
    np.testing.assert_allclose(fit.transform.matrix(), other.transform.matrix())
    tiny = procrustes(1e-170 * source, 1e-170 * target, weights)
    np.testing.assert_allclose(tiny.transform.rotation, fit.transform.rotation)
    np.testing.assert_allclose(1e170 * tiny.rmse, fit.rmse)
    assert tiny.result == RESULTS.successful
    motion = Rigid.exp(jnp.asarray([0.3, -1.2, 0.8, 4.0, 5.0, -6.0]))
    moved = procrustes(motion(source), motion(target), weights)
    expected = motion @ fit.transform @ motion.inverse()
    np.testing.assert_allclose(moved.transform.matrix(), expected.matrix(), atol=1e-12)


def test_vmap_is_a_loop_and_one_program_serves_all():
    rows = [x.astype(np.float32) for x in _problems(4)]
    rows[0][2] = rows[0][2][:1]
    batch = scaled_all(*rows)
    traced = []

    @jax.jit
    def one(a, b, w):
        traced.append(1)
        return procrustes(a, b, w, scaling=True)

    for i in range(4):
        single = one(*(x[i] for x in rows))
        for a, b in zip(*map(jax.tree.leaves, (batch, single)), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-5, atol=1e-5)
    assert len(traced) == 1
    bad = batch.result == RESULTS.degenerate_input
    assert list(np.asarray(bad)) == [False, False, True, False]


@pytest.mark.parametrize("dimension", [2, 3, 5])
def test_nearest_rotation_beats_its_neighbors(dimension, x64):
    rng = np.random.default_rng(5)
    matrix = rng.normal(size=(dimension, dimension))
    best = nearest_rotation(jnp.asarray(matrix))
    np.testing.assert_allclose(best @ best.T, np.eye(dimension), atol=1e-14)
    for _ in range(20):
        turn = np.linalg.qr(np.eye(dimension) + 0.1 * rng.normal(size=matrix.shape))[0]
        turn *= np.sign(np.diag(turn))
        assert np.sum((best @ turn - matrix) ** 2) >= np.sum((best - matrix) ** 2)


def test_wrong_shapes_are_refused():
    for a, b in [(GENERIC, GENERIC[:3]), (GENERIC[0], GENERIC[0])]:
        with pytest.raises(GeometryError, match="must have shape"):
            procrustes(a, b)
    with pytest.raises(GeometryError, match="two coordinates"):
        procrustes(GENERIC[:, :1], GENERIC[:, :1])
    with pytest.raises(GeometryError, match="weights must have shape"):
        procrustes(GENERIC, GENERIC, np.ones(3))
    with pytest.raises(GeometryError, match="mask must have shape"):
        procrustes(GENERIC, GENERIC, mask=np.ones(3, bool))
