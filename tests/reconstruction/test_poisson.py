"""Poisson reconstruction against a torus that is known exactly."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import RESULTS, Grid, PointCloud
from jaxgeom.reconstruction import (
    SSD,
    Dirichlet,
    Envelope,
    Poisson,
    ScreenedPoisson,
    Wavelet,
    poisson,
    screened_poisson,
)
from jaxgeom.reconstruction._wavelet import indicator

RESOLUTION = 32
MAJOR, MINOR = 1.3, 0.55


def _torus(n, seed=0, noise=0.0, dtype=np.float32):
    """Samples of equal area on a torus away from the origin."""
    rng = np.random.default_rng(seed)
    u, v, keep = rng.uniform(0, 2 * np.pi, (3, 3 * n))
    accept = keep / (2 * np.pi) < (MAJOR + MINOR * np.cos(v)) / (MAJOR + MINOR)
    u, v = u[accept][:n], v[accept][:n]
    normals = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], -1)
    ring = np.stack([np.cos(u), np.sin(u), np.zeros_like(u)], -1)
    points = MAJOR * ring + MINOR * normals + noise * rng.normal(size=(n, 1)) * normals
    return PointCloud((points + [0.3, -2.0, 5.0]).astype(dtype), normals.astype(dtype))


def _distance(points):
    p = np.asarray(points, np.float64) - [0.3, -2.0, 5.0]
    return np.hypot(np.hypot(p[..., 0], p[..., 1]) - MAJOR, p[..., 2]) - MINOR


def _grid(cloud):
    return Grid.around(cloud, resolution=RESOLUTION)


def _surface_error(out):
    """Distance of the zero crossing along the true normal, in cells."""
    cloud = _torus(300, seed=9)
    h = float(out.grid.spacing[0])
    steps = np.linspace(-2, 2, 81)
    lines = cloud.points[:, None] + h * steps[:, None] * cloud.normals[:, None]
    values = np.asarray(jax.vmap(jax.vmap(out))(jnp.asarray(lines, jnp.float32)))
    crossing = np.argmax(values > 0, axis=1)
    assert (crossing > 0).all()
    return np.sqrt(np.mean(steps[crossing] ** 2))


METHODS = [Poisson(), ScreenedPoisson(), ScreenedPoisson(screening=4.0)]


def _field_with_the_sign_of_the_torus(method):
    cloud = _torus(6000)
    out = jax.jit(method)(cloud, _grid(cloud))
    assert out.result == RESULTS.successful
    distance = _distance(out.grid.nodes())
    clear = np.abs(distance) > 2 * float(out.grid.spacing[0])
    sign = np.asarray(out.values) > float(out.level)
    assert (sign == (distance > 0))[clear].all()
    return out, distance


@pytest.mark.parametrize("method", METHODS)
def test_field_has_the_sign_and_the_place_of_the_torus(method):
    out, distance = _field_with_the_sign_of_the_torus(method)
    assert _surface_error(out) < 0.12
    inside = np.asarray(out.values)[distance < -0.4]
    np.testing.assert_allclose(inside - float(out.level), -0.5, atol=0.12)


@pytest.mark.slow
def test_wavelets_have_the_sign_and_the_place_of_the_torus():
    out, distance = _field_with_the_sign_of_the_torus(Wavelet())
    assert _surface_error(out) < 0.12
    inside, outside = (
        np.mean(np.asarray(out.values)[side])
        for side in (distance < -0.4, distance > 0.4)
    )
    np.testing.assert_allclose(outside - inside, 1, atol=0.06)


def test_wavelets_of_a_box_are_its_share_of_every_cell():
    """Fluxes are constant over half-cells of faces: sums at their middles are exact."""
    shape = (13, 10, 12)
    low, high = np.array([2.25, 3.5, 1.75]), np.array([9.75, 6.25, 11.0])
    points, vectors = [], []
    for d in range(3):
        lines = [np.arange(a + 0.125, b, 0.25) for a, b in zip(low, high, strict=True)]
        for end, sign in ((low, -1), (high, 1)):
            lines[d] = end[d : d + 1]
            face = np.stack(np.meshgrid(*lines, indexing="ij"), -1).reshape(-1, 3)
            points.append(face)
            vectors.append(sign / 16 * np.tile(np.eye(3)[d], (len(face), 1)))
    found = jax.jit(indicator, static_argnums=2)(
        np.float32(np.concatenate(points)), np.float32(np.concatenate(vectors)), shape
    )
    nodes = [np.arange(n) for n in shape]
    x, y, z = (
        np.clip(np.minimum(i + 0.5, b) - np.maximum(i - 0.5, a), 0, 1)
        for i, a, b in zip(nodes, low, high, strict=True)
    )
    share = x[:, None, None] * y[:, None] * z
    np.testing.assert_allclose(found, share, atol=1e-5)


def test_smooth_signed_distance_is_the_distance_near_the_samples():
    out, distance = _field_with_the_sign_of_the_torus(SSD())
    assert _surface_error(out) < 0.06
    h = float(out.grid.spacing[0])
    values = np.asarray(out.values) - float(out.level)
    near = np.abs(distance) < 1.5 * h
    assert np.sqrt(np.mean((values - distance)[near] ** 2)) < 0.2 * h


def test_areas_sum_to_the_area_of_the_surface():
    cloud = _torus(6000)
    out = jax.jit(ScreenedPoisson())(cloud, _grid(cloud))
    true = 4 * np.pi**2 * MAJOR * MINOR
    np.testing.assert_allclose(out.stats.area.sum(), true, rtol=0.06)
    density = np.asarray(out.density_at(cloud.points))
    np.testing.assert_allclose(np.median(density), 6000 / true, rtol=0.15)


@pytest.mark.parametrize("noise", [0.02, 0.05])
def test_noise_is_estimated_and_lowers_the_screening(noise):
    clean, noisy = _torus(8000), _torus(8000, noise=noise)
    run = jax.jit(ScreenedPoisson())
    a, b = run(clean, _grid(clean)), run(noisy, _grid(noisy))
    np.testing.assert_allclose(b.stats.noise, noise, rtol=0.35)
    assert b.stats.screening < a.stats.screening


@pytest.mark.parametrize("boundary", ["dirichlet", "envelope"])
def test_fixed_nodes_are_outside(boundary):
    cloud = _torus(4000)
    grid = _grid(cloud)
    edge = Dirichlet()
    if boundary == "envelope":
        edge = Envelope(jnp.asarray(_distance(grid.nodes()) > 0.3))
    method = ScreenedPoisson(boundary=edge, max_steps=80)
    out = eqx.filter_jit(method)(cloud, grid)
    assert out.result == RESULTS.successful
    fixed = np.asarray(edge.fixed(grid.shape))
    np.testing.assert_allclose(np.asarray(out.values)[fixed], 0.5, atol=1e-6)
    assert _surface_error(out) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    "method",
    [ScreenedPoisson(screening=2.0, levels=1), Wavelet(levels=1), SSD(levels=1)],
)
def test_padding_changes_nothing_and_has_no_gradient(method):
    cloud = _torus(1500)
    grid = _grid(cloud)
    pad = lambda x: jnp.concatenate([jnp.asarray(x), jnp.full((300, 3), jnp.nan)])
    mask = jnp.arange(1800) < 1500
    padded = PointCloud(pad(cloud.points), pad(cloud.normals), mask)

    def total(points, normals, mask):
        values = method(PointCloud(points, normals, mask), grid).values
        return jnp.sum(values**2), values

    run = jax.jit(jax.grad(total, argnums=(0, 1), has_aux=True))
    (slope, _), values = run(cloud.points, cloud.normals, cloud.mask)
    (padded_slope, turned), same = run(padded.points, padded.normals, mask)
    np.testing.assert_allclose(same, values, atol=1e-5)
    np.testing.assert_allclose(padded_slope[:1500], slope, atol=2e-3)
    assert (padded_slope[1500:] == 0).all() and (turned[1500:] == 0).all()


def test_weights_are_confidence():
    """A displaced copy of the cloud with no confidence does not move the surface."""
    cloud, grid = _torus(3000), _grid(_torus(3000))
    wrong = cloud.points + 0.2 * cloud.normals
    both = PointCloud(
        np.concatenate([cloud.points, wrong]), np.concatenate([cloud.normals] * 2)
    )
    weights = jnp.concatenate([jnp.full(3000, 2.0), jnp.full(3000, 1e-3)])
    run = jax.jit(ScreenedPoisson(screening=4.0))
    out = run(both, grid, weights=weights)
    assert _surface_error(out) < 0.35
    assert _surface_error(run(both, grid)) > 2 * _surface_error(out)


# The step of the differences: the fourth order of SSD amplifies rounding errors.
_MAKERS = [
    (lambda w: ScreenedPoisson(w, levels=1, rtol=1e-12, max_steps=200), 1e-7),
    (lambda w: SSD(w, levels=1, rtol=1e-12, max_steps=400), 1e-5),
    (lambda w: Wavelet(levels=1), 1e-7),
]


@pytest.mark.slow
@pytest.mark.parametrize(("make", "step"), _MAKERS)
def test_gradients_are_central_differences(make, step, x64):
    cloud = _torus(700, dtype=np.float64)
    grid = _grid(cloud)
    rng = np.random.default_rng(1)
    probe = jnp.asarray(rng.normal(size=grid.shape))

    def loss(points, normals, weights, screening):
        out = make(screening)(PointCloud(points, normals), grid, weights=weights)
        return jnp.vdot(probe, out.values) + 10 * out.level

    args = [jnp.asarray(a) for a in (cloud.points, cloud.normals, np.ones(700), 3.0)]
    ways = [jnp.asarray(rng.normal(size=a.shape)) for a in args]
    gradient = jax.jit(jax.grad(loss, argnums=(0, 1, 2, 3)))(*args)
    moved = jax.jit(lambda i, t: loss(*_shift(args, ways, i, t)))
    for i in range(4):
        mask = jnp.arange(4) == i
        central = (moved(mask, step) - moved(mask, -step)) / (2 * step)
        np.testing.assert_allclose(
            jnp.vdot(gradient[i], ways[i]), central, rtol=1e-5, atol=1e-7
        )


def _shift(args, ways, mask, t):
    return [
        a + t * mask[i] * w for i, (a, w) in enumerate(zip(args, ways, strict=True))
    ]


def test_statuses():
    cloud = _torus(800)
    grid = _grid(cloud)
    run = jax.jit(lambda c, g: ScreenedPoisson(levels=0)(c, g).result)
    normals = np.array(cloud.normals)
    normals[3] = 0
    assert run(PointCloud(cloud.points, normals), grid) == RESULTS.zero_normals
    points = np.array(cloud.points)
    points[5] = np.inf
    assert run(PointCloud(points, cloud.normals), grid) == RESULTS.nonfinite_input
    points[5] = 100.0
    assert run(PointCloud(points, cloud.normals), grid) == RESULTS.outside_grid
    few = PointCloud(cloud.points, cloud.normals, np.arange(800) < 3)
    assert run(few, grid) == RESULTS.too_few_points
    assert run(cloud, grid) == RESULTS.successful
    early = jax.jit(ScreenedPoisson(max_steps=1, rtol=1e-6, levels=0))(cloud, grid)
    assert early.result == RESULTS.not_converged


@pytest.mark.slow
@pytest.mark.parametrize("method", [Wavelet(levels=0), SSD(levels=0)])
def test_vmap_is_a_loop(method):
    clouds = [_torus(800, seed) for seed in (0, 1)]
    grid = _grid(clouds[0])
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *clouds)
    many = jax.jit(jax.vmap(lambda c: method(c, grid)))(stacked)
    assert np.asarray(many.result == RESULTS.successful).tolist() == [True, True]
    one = jax.jit(method)
    for i, cloud in enumerate(clouds):
        alone = one(cloud, grid)
        np.testing.assert_allclose(many.values[i], alone.values, atol=1e-4)
        assert many.stats.steps[i] == alone.stats.steps
        assert alone.result == RESULTS.successful


@pytest.mark.slow
def test_functions_and_settings_agree():
    cloud = _torus(800)
    grid = _grid(cloud)
    a = screened_poisson(cloud, grid, screening=2.0, levels=0)
    b = ScreenedPoisson(screening=2.0, levels=0)(cloud, grid)
    np.testing.assert_array_equal(a.values, b.values)
    c = poisson(cloud, grid, levels=0)
    assert int(c.stats.steps) == 0 and float(c.stats.screening) == 0
