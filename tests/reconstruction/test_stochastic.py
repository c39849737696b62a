"""The posterior over fields against closed forms, dense algebra and real scans."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import RESULTS
from jaxgeom._core import GeometryError
from jaxgeom.fields import Camera
from jaxgeom.meshes import icosphere, keep_faces
from jaxgeom.reconstruction import (
    Matern,
    SquaredExponential,
    StochasticPoisson,
    calibrate_values,
    face_probability,
    next_view,
    probability_hit,
    stochastic_poisson,
    tune,
    view_score,
)
from jaxgeom.shapes import Grid, PointCloud, TriangleMesh

SHAPE = (8, 7, 9)
SETTINGS = dict(noise=0.2, variance=0.4, rtol=1e-10, max_steps=200, rank=3)


def unit_vectors(rng, num):
    drawn = rng.standard_normal((num, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def small(seed=0, n=6, dtype=np.float64):
    """A few samples in the middle of a box that is no cube, and queries."""
    rng = np.random.default_rng(seed)
    spacing = np.array([0.5, 0.6, 0.45])
    grid = Grid(np.array([-1.0, 0.3, 2.0], dtype), spacing.astype(dtype), SHAPE)
    inner = grid.origin + spacing * (1 + rng.random((n + 3, 3)) * (np.array(SHAPE) - 3))
    normals = unit_vectors(rng, n)
    cloud = PointCloud(jnp.asarray(inner[:n], dtype), jnp.asarray(normals, dtype))
    return cloud, grid, jnp.asarray(inner[n:], dtype)


def dense_rows(grid, points):
    """W as a matrix."""
    out = np.zeros((len(points), *grid.shape))
    q = (np.asarray(points) - grid.origin) / grid.spacing
    base = np.floor(q).astype(int)
    for corner in range(8):
        step = np.array([corner & 1, corner >> 1 & 1, corner >> 2])
        share = np.prod(np.where(step, q - base, 1 - (q - base)), axis=1)
        for row, at, s in zip(out, base + step, share, strict=True):
            row[tuple(at)] += s
    return out.reshape(len(points), -1)


def dense_covariance(cloud, grid, points, kernel, variance):
    """Of v and of the anchored f, at the samples and at points, by sums over
    frequencies: [4, n + m, 4, n + m]."""
    size = [n * h for n, h in zip(grid.shape, grid.spacing, strict=True)]
    whole = [np.fft.fftfreq(n, 1 / n) for n in grid.shape]
    k = np.stack(np.meshgrid(*whole, indexing="ij"), -1).reshape(-1, 3)
    nyquist = 2 * np.abs(k) == np.array(grid.shape)
    k = 2 * np.pi * k / size
    rho = np.asarray(kernel.spectrum(np.sum(k**2, axis=1)))
    rho = variance * rho / rho.sum()
    nodes = np.asarray(grid.nodes()).reshape(-1, 3)
    waves = np.exp(1j * nodes @ k.T)
    square = np.where(np.arange(len(k)) > 0, np.sum(k**2, axis=1), np.inf)
    ascent = np.where(nyquist, 0, k).T / square
    at, to = dense_rows(grid, cloud.points), dense_rows(grid, points)
    look = np.concatenate([at, to])
    looks = [look, look, look, look - at.mean(0)]
    # What a wave of v_d is in v_1, v_2, v_3 and f; the waves of the three are apart.
    shares = np.concatenate([np.eye(3)[:, :, None] + 0 * ascent[0], -1j * ascent[None]])
    parts = [
        np.concatenate(
            [w @ (waves * r) for w, r in zip(looks, shares[:, d], strict=True)]
        )
        for d in range(3)
    ]
    cov = sum((part * rho @ part.conj().T).real for part in parts)
    return cov.reshape(4, len(look), 4, len(look))


def dense_posterior(cloud, grid, points, kernel, noise, variance, value_noise=None):
    """Mean [4, m] of v and of the anchored field at points, covariance [4, m, 4, m]."""
    n, m = len(cloud.points), len(points)
    cov = dense_covariance(cloud, grid, points, kernel, variance)
    sigma = np.array([noise] * 3 + ([] if value_noise is None else [value_noise]))
    k = len(sigma)
    rows = np.zeros((k, n))
    rows[:3] = np.asarray(cloud.normals).T
    seen = cov[:k, :n, :k, :n].reshape(k * n, k * n)
    cross = cov[:, n:, :k, :n].reshape(4 * m, k * n)
    gain = cross @ np.linalg.inv(seen + np.diag(np.repeat(sigma**2, n)))
    known = (gain @ cross.T).reshape(4, m, 4, m)
    return (gain @ rows.ravel()).reshape(4, m), cov[:, n:, :, n:] - known


@pytest.mark.parametrize(
    ("kernel", "value_noise"),
    [
        (Matern(1.1), None),
        (Matern(1.1), 0.03),
        pytest.param(SquaredExponential(0.8), None, marks=pytest.mark.slow),
    ],
)
def test_mean_and_deviation_are_those_of_dense_algebra(x64, kernel, value_noise):
    cloud, grid, points = small()
    found = _run(cloud, grid, kernel, value_noise)
    means, covariance = dense_posterior(
        cloud, grid, points, kernel, 0.2, 0.4, value_noise=value_noise
    )
    assert found.result == RESULTS.successful
    mean, std = jax.jit(lambda p, x: p.normals_at(x))(found, points)
    np.testing.assert_allclose(mean, means[:3].T, rtol=1e-7, atol=1e-9)
    variance = np.einsum("dmdm->md", covariance)
    np.testing.assert_allclose(std, np.sqrt(variance[:, :3]), rtol=1e-6)
    expected, cov = means[3], covariance[3, :, 3]
    np.testing.assert_allclose(jax.vmap(found)(points), expected, rtol=1e-7, atol=1e-9)
    std = np.sqrt(np.diag(cov))
    np.testing.assert_allclose(_std(found, points), std, rtol=1e-6)
    inside = found.probability_inside(points)
    z = expected / std
    normal = jax.scipy.stats.norm
    np.testing.assert_allclose(inside, normal.cdf(-z), rtol=1e-5)
    np.testing.assert_allclose(
        found.surface_density(points), normal.pdf(z) / std, rtol=1e-5
    )


@jax.jit
def _std(posterior, points):
    return posterior.std(points)


@jax.jit
def _run(cloud, grid, kernel, value_noise=None):
    settings = dict(SETTINGS, value_noise=value_noise)
    return stochastic_poisson(cloud, grid, kernel=kernel, **settings)


@pytest.mark.slow
def test_samples_have_the_mean_and_the_covariance(x64):
    cloud, grid, points = small()
    found = _run(cloud, grid, Matern(1.1))
    draw = jax.jit(lambda p, key: p.samples(key, 4000))
    fields = draw(found, jax.random.key(1))
    to = dense_rows(grid, points)
    values = np.asarray(fields).reshape(4000, -1) @ to.T
    means, covariance = dense_posterior(cloud, grid, points, Matern(1.1), 0.2, 0.4)
    mean, cov = means[3], covariance[3, :, 3]
    # Five standard errors of 4000 draws.
    std = np.sqrt(np.diag(cov))
    assert np.all(np.abs(values.mean(0) - mean) < 5 * std / np.sqrt(4000))
    product = np.sqrt(np.outer(std**2, std**2) + cov**2)
    assert np.all(np.abs(np.cov(values.T) - cov) < 5 * product / np.sqrt(4000))
    hit = probability_hit(fields, grid, points[None])
    np.testing.assert_allclose(hit[0], (values < 0).any(1).mean(), atol=1e-12)


@pytest.mark.slow
def test_closed_forms_on_the_torus(x64):
    """The covariances of the continuous model, of period 2 pi, without a grid."""
    n, length = 48, 0.7
    h = 2 * np.pi / n
    grid = Grid(jnp.zeros(3), jnp.full(3, h), (n,) * 3)
    rng = np.random.default_rng(3)
    points, normals = 1.5 + 3 * rng.random((12, 3)), unit_vectors(rng, 12)
    queries = 1.2 + 3.5 * rng.random((20, 3))
    whole = np.arange(-12, 13)
    k = np.stack(np.meshgrid(whole, whole, whole, indexing="ij"), -1).reshape(-1, 3)
    square = np.sum(k**2, axis=1).astype(float)
    rho = np.exp(-square * length**2 / 2)
    rho *= 0.4 / rho.sum()
    square[square == 0] = np.inf
    pair = lambda a, b, w, f: f((a[:, None] - b[None]) @ k.T) @ w
    gram = pair(points, points, rho, np.cos) + 0.2**2 * np.eye(12)
    inverse = np.linalg.inv(gram)
    mean, known = 0, 0
    for d in range(3):
        weight = k[:, d] * rho / square
        anchor = pair(points, points, weight, np.sin).mean(0)
        cross = pair(queries, points, weight, np.sin) - anchor
        mean = mean + cross @ inverse @ normals[:, d]
        known = known + np.sum(cross @ inverse * cross, axis=1)
    own = functools.partial(pair, w=rho / square, f=np.cos)
    prior = own(queries[:1], queries[:1])[0, 0] - 2 * own(queries, points).mean(1)
    std = np.sqrt(prior + own(points, points).mean() - known)
    cloud = PointCloud(jnp.asarray(points), jnp.asarray(normals))
    found = _run(cloud, grid, SquaredExponential(length))
    error = np.abs(jax.vmap(found)(jnp.asarray(queries)) - mean)
    assert error.max() < 0.01 * np.abs(mean).max()
    np.testing.assert_allclose(_std(found, jnp.asarray(queries)), std, rtol=0.02)


def test_padding_has_no_influence(x64):
    cloud, grid, points = small()
    bad = jnp.full((2, 3), jnp.nan)
    padded = PointCloud(
        jnp.concatenate([cloud.points, bad]),
        jnp.concatenate([cloud.normals, bad]),
        jnp.arange(8) < 6,
    )
    kernel = Matern(1.1)
    one, other = _run(cloud, grid, kernel), _run(padded, grid, kernel)
    assert other.result == RESULTS.successful
    np.testing.assert_allclose(other.values, one.values, atol=1e-12)
    np.testing.assert_allclose(_std(other, points), _std(one, points), rtol=1e-9)
    draw = jax.jit(lambda p, key: p.samples(key, 2))
    assert np.isfinite(draw(other, jax.random.key(0))).all()

    def loss(normals):
        c = PointCloud(padded.points, normals, padded.mask)
        return jnp.sum(_run(c, grid, kernel).values ** 2)

    slope = jax.grad(loss)(padded.normals.at[6:].set(0.3))
    assert np.all(np.asarray(slope[6:]) == 0) and np.any(np.asarray(slope[:6]) != 0)


@pytest.mark.slow
def test_vmap_is_the_loop(x64):
    clouds = [small(seed)[0] for seed in range(3)]
    grid, points = small()[1:]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *clouds)

    def one(cloud):
        found = stochastic_poisson(cloud, grid, kernel=Matern(1.1), **SETTINGS)
        return found.values, found.std(points), found.steps

    many = jax.jit(jax.vmap(one))(stacked)
    alone = [jax.jit(one)(c) for c in clouds]
    for got, expected in zip(many, zip(*alone, strict=True), strict=True):
        np.testing.assert_allclose(got, np.stack(expected), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("believed", [False, True])
def test_derivatives_are_central_differences(x64, believed):
    """First ones, and along one line the second: deviations are least values."""
    cloud, grid, points = small()

    def scalar(moved, length, noise, value_noise, at):
        c = PointCloud(moved, cloud.normals)
        settings = {**SETTINGS, "noise": noise}
        if believed:
            settings["value_noise"] = value_noise
        found = stochastic_poisson(c, grid, kernel=Matern(length), **settings)
        mean, std = found.normals_at(at[:1])
        first = jnp.sum(found.std(at)) + jnp.sum(jax.vmap(found)(at) ** 2)
        return first + jnp.sum(mean * std)

    at = (cloud.points, jnp.float64(1.1), jnp.float64(0.2), jnp.float64(0.1), points)
    gradient = jax.jit(jax.grad(scalar, argnums=range(5)))
    value = jax.jit(scalar)
    rng = np.random.default_rng(5)
    draw = [rng.standard_normal(np.shape(x)) for x in at]
    slopes, h = gradient(*at), 1e-5
    for i, (x, along) in enumerate(zip(at, draw, strict=True)):
        moved = lambda s, i=i, a=along, x=x: value(*at[:i], x + s * a, *at[i + 1 :])
        expected = (moved(h) - moved(-h)) / (2 * h)
        np.testing.assert_allclose(
            np.sum(slopes[i] * along), expected, rtol=2e-5, atol=1e-9
        )
    line = lambda t: scalar(at[0], *(x + t for x in at[1:4]), at[4])
    slope = jax.jit(jax.grad(line))
    bent = jax.jit(jax.grad(jax.grad(line)))(0.0)
    np.testing.assert_allclose(bent, (slope(h) - slope(-h)) / (2 * h), rtol=1e-5)


def test_a_view_of_what_is_unknown_scores_high_and_has_a_slope(x64):
    cloud, grid, _ = small()
    fields = jnp.ones((3, *SHAPE)) * jnp.array([0.9, 1.0, 1.1])[:, None, None, None]
    unsure = fields.at[:, 3:5, 2:5].set(
        jnp.array([-1.0, 0.0, 1.1])[:, None, None, None]
    )
    start = jnp.asarray(grid.origin)[None] + jnp.array([[0.1, 1.8, 1.7]])
    along = jnp.array([[1.0, 0.0, 0.0]])
    score = lambda v, x: view_score(v, grid, x, along, length=3.5, num_steps=50)
    assert score(fields, start) < 1e-6 < 0.05 < score(unsure, start)
    slope = jax.grad(score, argnums=1)(unsure, start)
    h = 1e-6
    moved = lambda s: score(unsure, start + s * jnp.array([[0.0, 1.0, 0.0]]))
    np.testing.assert_allclose(slope[0, 1], (moved(h) - moved(-h)) / (2 * h), rtol=1e-4)


def test_a_face_is_as_probable_as_planes_near_it():
    grid = Grid(np.array([-1.0, -2.0, 0.5]), np.array([0.25, 0.5, 0.125]), (9, 9, 17))
    nodes, rng = np.asarray(grid.nodes()), np.random.default_rng(0)
    heights = rng.uniform(1.1, 1.9, 40)
    samples = jnp.asarray(nodes[..., 2] - heights[:, None, None, None])
    corners = np.array([[-0.4, -0.3, 1.5], [0.5, -0.2, 1.5], [0.1, 0.6, 1.5]])
    outside = corners + np.array([0.0, 0.0, 0.95])
    faces = np.array([[0, 1, 2], [3, 4, 5], [6, 6, 6]], np.int32)
    mesh = TriangleMesh(jnp.asarray(np.concatenate([corners, outside])), faces)
    for distance in (0.05, 0.2):
        found = face_probability(mesh, samples, grid, distance=distance)
        share = np.mean(np.abs(heights - 1.5) < distance)
        assert 0 < share < 1
        # The second face reaches out of the grid, the third is padding.
        np.testing.assert_allclose(found, [share, 0, 0], atol=1e-6)
    turned = TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])
    again = jax.jit(face_probability)(turned, samples, grid, distance=0.2)
    np.testing.assert_array_equal(again, found)
    both = jax.vmap(lambda d: face_probability(mesh, samples, grid, distance=d))
    np.testing.assert_array_equal(both(jnp.array([0.05, 0.2]))[1], found)
    unknown = samples.at[3].set(jnp.nan)
    found = face_probability(mesh, unknown, grid, distance=0.2)
    np.testing.assert_array_equal(np.isnan(found), [True, False, False])


@pytest.mark.slow
def test_trimming_keeps_what_was_scanned():
    rng = np.random.default_rng(1)
    normals = unit_vectors(rng, 400)
    normals = normals[normals[:, 1] > 0]
    center, radius = np.array([0.3, -0.2, 0.1]), 0.9
    cloud = PointCloud(
        *(jnp.asarray(x, jnp.float32) for x in (center + radius * normals, normals))
    )
    grid = Grid(jnp.asarray(center - 2.4), jnp.full(3, 0.2), (24, 24, 24))
    posterior = jax.jit(stochastic_poisson)(cloud, grid)
    samples = posterior.samples(jax.random.key(3), 24)
    ball = icosphere(2, radius=radius)
    ball = TriangleMesh(ball.vertices + jnp.asarray(center, jnp.float32), ball.faces)
    height = np.asarray(jnp.mean(ball.triangles(), axis=1))[:, 1] - center[1]
    near, far = (
        np.asarray(face_probability(ball, samples, grid, distance=d))
        for d in (0.1, 0.2)
    )
    assert np.mean(far[height > 0.3]) > 0.8 > 0.5 > np.mean(far[height < -0.5])
    assert np.mean(near) < np.mean(far)
    kept = keep_faces(ball, jnp.asarray(far >= 0.7)).trim()
    kept_height = np.asarray(jnp.mean(kept.triangles(), axis=1))[:, 1] - center[1]
    assert np.sum(kept_height > 0.3) > 0.9 * np.sum(height > 0.3)
    assert np.sum(kept_height < -0.5) < 0.02 * np.sum(height < -0.5)


@pytest.mark.slow
def test_statuses_and_errors(x64):
    cloud, grid, _ = small()
    few_steps = dict(rtol=1e-6, max_steps=300)
    few = PointCloud(cloud.points[:2], cloud.normals[:2])
    run = lambda c, **s: stochastic_poisson(c, grid, kernel=Matern(1.1), **s).result
    assert run(few) == RESULTS.too_few_points
    assert run(cloud, rtol=1e-12, max_steps=1, rank=0) == RESULTS.not_converged
    assert run(cloud, weights=jnp.ones(6)) == RESULTS.successful
    stopped = stochastic_poisson(
        cloud, grid, kernel=Matern(1.1), max_steps=1, rtol=1e-9, rank=0
    )
    assert np.isnan(stopped.std(cloud.points[:1])).all()
    known = stochastic_poisson(cloud, grid, kernel=Matern(1.1), noise=1e-9, **few_steps)
    slope = jax.grad(lambda x: jnp.sum(known.normals_at(x)[1]))(cloud.points)
    assert np.isfinite(slope).all()
    empty = jnp.ones((4, *SHAPE))
    ray = (grid.origin[None] + 0.5, jnp.array([[1.0, 0.0, 0.0]]))
    assert view_score(empty, grid, *ray, length=2.0) == 0
    torn = empty.at[2].set(jnp.nan)
    assert np.isnan(probability_hit(torn, grid, cloud.points))
    assert probability_hit(empty, grid, cloud.points) == 0
    middle = grid.origin + grid.spacing * (np.array(SHAPE) - 1) / 2
    camera = Camera(middle + np.array([4.0, 0.0, 0.0]), middle)
    lost = next_view(torn, grid, camera, length=6.0)
    assert lost.result == RESULTS.nonfinite_input
    with pytest.raises(GeometryError, match="held-out"):
        tune(cloud, grid, PointCloud(cloud.points), length=1.0)
    with pytest.raises(GeometryError, match="with normals"):
        StochasticPoisson()(PointCloud(cloud.points), grid)
    out = stochastic_poisson(cloud, grid, weights=jnp.arange(6) > 0.0)
    rest = PointCloud(cloud.points[1:], cloud.normals[1:])
    np.testing.assert_allclose(
        out.values, stochastic_poisson(rest, grid).values, atol=1e-3
    )


def parts(points, normals):
    """From a slice to a cloud of these rows, in single precision."""
    cloud = PointCloud(jnp.asarray(points, jnp.float32), jnp.float32(normals))
    return lambda part: jax.tree.map(lambda x: x[part], cloud)


@pytest.mark.slow
def test_tuned_intervals_hold_what_they_say():
    """A few wild normals widen a Gaussian; the last factor corrects it."""
    rng = np.random.default_rng(2)
    unit = unit_vectors(rng, 700)
    normals = unit + 0.05 * rng.standard_normal(unit.shape)
    wild = rng.random(700) < 0.06
    normals[wild] += rng.standard_normal((wild.sum(), 3))
    some = parts(0.8 * unit, normals)
    grid = Grid(jnp.full(3, -1.6), jnp.full(3, 0.2), (16, 16, 16))
    cloud, held_out, others = some(slice(300)), some(slice(300, 400)), slice(400, 700)
    found = jax.jit(lambda a, b: tune(a, grid, b, length=0.6, num_likely=80))(
        cloud, held_out
    )
    assert found.result == RESULTS.successful
    assert float(found.loss) < float(found.first_loss) - 0.1
    assert 0.3 < float(found.widening) < 0.95
    test = some(others)
    mean, std = found.settings(cloud, grid).normals_at(test.points)
    wide = jnp.sqrt(std**2 + found.settings.noise**2)
    covered = float(jnp.mean(jnp.abs(test.normals - mean) / wide < 1.6449))
    assert 0.85 < covered < 0.95
    before = float(
        jnp.mean(jnp.abs(test.normals - mean) / wide * found.widening < 1.6449)
    )
    assert before > covered


@pytest.mark.slow
def test_calibrated_places_are_as_far_off_as_they_are():
    """Points off a ball by 0.03: the deviation is found, and the interval holds."""
    rng = np.random.default_rng(4)
    unit = unit_vectors(rng, 900)
    normals = unit + 0.1 * rng.standard_normal(unit.shape)
    some = parts(unit * (0.8 + 0.03 * rng.standard_normal((900, 1))), normals)
    grid = Grid(jnp.full(3, -1.6), jnp.full(3, 0.2), (16, 16, 16))
    cloud, held_out, others = some(slice(300)), some(slice(300, 500)), slice(500, 900)
    prior = StochasticPoisson(Matern(0.6), noise=0.1)
    run = jax.jit(lambda a, b, **to: calibrate_values(prior, a, grid, b, **to))
    found = run(cloud, held_out)
    settings = found.settings
    assert found.result == RESULTS.successful
    assert 0.02 < float(settings.value_noise) < 0.045
    assert 0.895 < float(found.covered) < 0.93
    assert run(cloud, held_out, highest=0.01).result == RESULTS.not_converged

    @jax.jit
    def covered(settings):
        posterior, test = settings(cloud, grid), some(others).points
        wide = jnp.sqrt(posterior.std(test) ** 2 + settings.value_noise**2)
        return jnp.mean(jnp.abs(jax.vmap(posterior)(test)) < 1.6449 * wide)

    assert 0.85 < float(covered(settings)) < 0.95
    # Without them the same prior knows much less of where the surface is.
    plain = dataclasses.replace(settings, value_noise=None)
    std = jax.jit(lambda s: s(cloud, grid).std(cloud.points[:20]))
    assert np.median(std(plain)) > 1.5 * np.median(std(settings))


def test_the_next_view_looks_at_the_unknown_side():
    """Half of a ball is known: a camera moves round to the other half."""
    grid = Grid(jnp.full(3, -1.5), jnp.full(3, 0.25), (13, 13, 13))
    nodes = grid.nodes()
    ball = jnp.linalg.norm(nodes, axis=-1) - 0.8
    unsure = jnp.maximum(nodes[..., 1], 0) * 0.6
    draw = jnp.linspace(-1.2, 1.2, 8)[:, None, None, None]
    samples = ball + unsure * draw
    start = Camera(jnp.array([2.0, -1.5, 0.3]))
    look = {"length": 4.0, "size": (6, 6)}
    found = jax.jit(lambda c: next_view(samples, grid, c, **look))(start)
    assert float(found.score) > 1.2 * float(found.first_score)
    position = np.asarray(found.camera.position)
    np.testing.assert_allclose(
        np.linalg.norm(position), np.linalg.norm(start.position), rtol=1e-5
    )
    assert position[1] > 2.0
    rays = found.camera.directions((6, 6)).reshape(-1, 3)
    origins = jnp.broadcast_to(found.camera.position, rays.shape)
    again = view_score(samples, grid, origins, rays, length=4.0, num_steps=48)
    np.testing.assert_allclose(found.score, again, rtol=1e-5)
