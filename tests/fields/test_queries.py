"""Projection, nearest points, rays, samples, scans and the statue."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import fields as jf
from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.shapes import Grid

ELLIPSOID = jf.Ellipsoid((0.7, 0.4, 0.5), (0.1, -0.2, 0.15))


def central(function, x, h=1e-6):
    steps = h * jnp.eye(x.size)
    rows = [(function(x + e) - function(x - e)) / (2 * h) for e in steps]
    return jnp.stack(rows, axis=-1)


@pytest.mark.parametrize("query", [jf.project, jf.closest_point])
def test_surface_points_lie_on_the_surface_and_move_rightly(x64, query):
    points = np.random.default_rng(0).normal(size=(20, 3))
    points = jnp.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))
    found = jax.jit(jax.vmap(lambda p: query(ELLIPSOID, p)))(points)
    assert (found.result == RESULTS.successful).all()
    np.testing.assert_allclose(jf.value(ELLIPSOID, found.point), 0, atol=1e-12)
    move = jax.jit(lambda p: query(ELLIPSOID, p).point)
    np.testing.assert_allclose(
        jax.jacrev(move)(points[0]), central(move, points[0]), atol=1e-7
    )
    by_radii = jax.jit(lambda r: query(jf.Ellipsoid(r), points[1]).point)
    radii = jnp.array([0.7, 0.4, 0.5])
    np.testing.assert_allclose(
        jax.jacfwd(by_radii)(radii), central(by_radii, radii), atol=1e-7
    )


def test_closest_point_is_the_nearest_of_a_sampled_ellipsoid(x64):
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(200_000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    surface = ball * np.asarray(ELLIPSOID.radii) + np.asarray(ELLIPSOID.center)
    points = rng.uniform(-1.5, 1.5, (20, 3))
    points = points[np.asarray(jf.value(ELLIPSOID, jnp.asarray(points))) > 0]
    found = jax.vmap(lambda p: jf.closest_point(ELLIPSOID, p))(jnp.asarray(points))
    mine = np.linalg.norm(points - found.point, axis=1)
    best = np.linalg.norm(points[:, None] - surface, axis=-1).min(axis=1)
    assert (mine <= best + 1e-9).all() and (best - mine).max() < 1e-3


def test_a_point_without_gradient_is_not_converged():
    for query in (jf.project, jf.closest_point):
        found = query(jf.Sphere(0.5), jnp.zeros(3))
        assert found.result == RESULTS.not_converged
        assert np.isfinite(found.point).all()


def test_rays_hit_a_sphere_where_algebra_says(x64):
    sphere = jf.Sphere(0.6, (0.1, -0.2, 0.3))
    origin = jnp.array([2.0, 0.5, 1.0])
    targets = jnp.asarray(np.random.default_rng(2).uniform(-0.9, 0.9, (200, 3)))
    trace = lambda d: jf.sphere_trace(sphere, origin, d, max_distance=10.0)
    hits = jax.jit(jax.vmap(trace))(targets - origin)
    d = targets - origin
    d = d / jnp.linalg.norm(d, axis=1, keepdims=True)
    b = d @ (origin - sphere.center)
    root = b**2 - jnp.sum((origin - sphere.center) ** 2) + 0.36
    sure = np.abs(root) > 1e-6
    np.testing.assert_array_equal(hits.hit[sure], root[sure] > 0)
    real = np.asarray(hits.hit)
    np.testing.assert_allclose(
        hits.distance[real], (-b - jnp.sqrt(root))[real], atol=1e-8
    )
    out = (hits.point - sphere.center) / 0.6
    np.testing.assert_allclose(hits.normal[real], out[real], atol=1e-8)
    assert (hits.distance[~real] == 10).all() and (hits.normal[~real] == 0).all()
    one = trace(d[0])
    assert one.steps == hits.steps[0] and one.hit == hits.hit[0]


def test_the_derivative_of_a_hit_is_the_central_difference(x64):
    direction = jnp.array([-1.0, -0.3, -0.4])

    @jax.jit
    def distance(x):
        body = jf.Ellipsoid(x[:3]).blend(jf.Sphere(x[3], (0.2, 0.1, 0.3)), 0.2)
        hit = jf.sphere_trace(body, x[4:7], direction + x[7:], max_distance=8.0)
        return hit.distance

    x = jnp.array([0.5, 0.4, 0.3, 0.35, 2.0, 0.8, 1.0, 0.0, 0.0, 0.0])
    expected = central(distance, x, 1e-5)
    np.testing.assert_allclose(jax.grad(distance)(x), expected, atol=1e-6)
    np.testing.assert_allclose(jax.jacfwd(distance)(x), expected, atol=1e-6)


def test_a_ray_from_inside_hits_at_once():
    hit = jf.sphere_trace(jf.Sphere(0.5), jnp.zeros(3), jnp.ones(3), max_distance=5)
    assert hit.hit and hit.distance == 0


def test_sample_is_the_value_at_the_nodes_for_any_chunk():
    grid = Grid(jnp.array([-1.0, -0.7, 0.1]), jnp.array([0.3, 0.2, 0.15]), (5, 7, 6))
    expected = jf.value(ELLIPSOID, grid.nodes())
    for chunk in (13, 1000):
        values = jax.jit(lambda f, c=chunk: jf.sample(f, grid, chunk=c))(ELLIPSOID)
        np.testing.assert_allclose(values, expected, atol=1e-6)


def test_sampled_is_trilinear_and_clamped(x64):
    grid = Grid(jnp.array([-1.0, -0.7, 0.1]), jnp.array([0.3, 0.2, 0.15]), (5, 7, 6))
    f = lambda p: 1 + 2 * p[0] - p[1] + 3 * p[2] + p[0] * p[1] - p[0] * p[1] * p[2]
    field = jf.Sampled(grid, jf.sample(f, grid))
    top = grid.origin + grid.spacing * (jnp.array(grid.shape) - 1)
    inside = jax.random.uniform(
        jax.random.key(0), (50, 3), minval=grid.origin, maxval=top
    )
    np.testing.assert_allclose(jf.value(field, inside), jf.value(f, inside), atol=1e-12)
    outside = inside + jnp.array([5.0, 0.0, 0.0])
    nearest = outside.at[:, 0].set(top[0])
    np.testing.assert_allclose(
        jf.value(field, outside), jf.value(f, nearest), atol=1e-12
    )
    weights = jax.grad(lambda v: jf.Sampled(grid, v)(inside[0]))(field.values)
    assert np.count_nonzero(weights) == 8
    np.testing.assert_allclose(weights.sum(), 1, atol=1e-12)


@pytest.mark.slow
def test_scan_sees_the_surface_from_the_camera():
    statue = jf.demo_statue()
    cameras = [jf.Camera((0.5, -4.0, 1.0)), jf.Camera((3.0, 2.5, 0.4))]
    take = jax.jit(
        lambda noise, key: jf.scan(statue, cameras, rays=32, noise=noise, key=key)
    )
    cloud = take(0.0, jax.random.key(1))
    real = np.asarray(cloud.mask)
    assert cloud.points.shape == (2 * 32 * 32, 3) and 200 < real.sum() < 1500
    assert np.abs(jf.value(statue, cloud.points))[real].max() < 1e-4
    toward = np.asarray(cloud.attributes["viewpoint"] - cloud.points)
    assert (np.sum(toward * cloud.normals, axis=1)[real] >= 0).all()
    np.testing.assert_allclose(
        np.linalg.norm(cloud.normals, axis=1)[real], 1, atol=1e-5
    )
    assert (np.asarray(cloud.points)[~real] == 0).all()
    noisy = take(0.02, jax.random.key(1))
    moved = np.linalg.norm(noisy.points - cloud.points, axis=1)[real]
    assert 0.017 < np.sqrt(np.mean(moved**2)) < 0.023


def test_camera_pixels_undo_its_directions():
    camera = jf.Camera((1.0, -3.0, 1.5), (0.1, 0.2, 0.0), (0.1, 0.0, 1.0), 40.0)
    points = camera.position + 2.5 * camera.directions((11, 17))
    column, row, depth = np.moveaxis(np.asarray(camera.pixels(points, (11, 17))), -1, 0)
    np.testing.assert_allclose(
        column, np.broadcast_to(np.arange(17), (11, 17)), atol=1e-4
    )
    np.testing.assert_allclose(row, np.arange(11)[:, None] + np.zeros(17), atol=1e-4)
    assert (depth > 0).all()


def test_camera_around_sees_all_points():
    points = np.random.default_rng(0).uniform(5, 6, (100, 3))
    column, row, _ = jf.Camera.around(points).pixels(jnp.asarray(points), (50, 50)).T
    assert min(column.min(), row.min()) >= -0.5 and max(column.max(), row.max()) <= 49.5


def test_the_statue_is_one_body_of_genus_one():
    trimesh = pytest.importorskip("trimesh")
    measure = pytest.importorskip("skimage.measure")
    n = 97
    grid = Grid(jnp.full(3, -1.05), jnp.full(3, 2.1 / (n - 1)), (n, n, n))
    values = np.array(jax.jit(jf.sample)(jf.demo_statue(), grid))
    vertices, faces, _, _ = measure.marching_cubes(values, 0.0)
    mesh = trimesh.Trimesh(vertices, faces)
    assert mesh.is_watertight and mesh.body_count == 1 and mesh.euler_number == 0
    borders = [np.take(values, i, axis=d) for d in range(3) for i in (2, n - 3)]
    assert min(border.min() for border in borders) > 0


def test_pruned_samples_are_those_near_the_surface():
    """Exact in the width, of the right sign beyond, from a part of the bricks."""
    body = jf.Torus(0.9, 0.21).rotate(np.eye(3)[[1, 2, 0]]) | jf.Sphere(0.3)
    spacing = np.float32([0.06, 0.07, 0.05])
    grid = Grid(np.float32([-1.5, -1.4, -1.3]), spacing, (51, 43, 50))
    full = np.asarray(jf.sample(body, grid))
    run = jax.jit(jf.sample_near_surface, static_argnames="capacity")
    out = run(body, grid, 0.0312, width=0.12, capacity=200)
    values, bricks = np.asarray(out.values), int(out.required_bricks)
    assert out.result == RESULTS.successful and 0 < bricks < 200 < 7 * 6 * 7
    np.testing.assert_array_equal(values < 0.0312, full < 0.0312)
    near = np.abs(full - 0.0312) <= 0.12
    np.testing.assert_allclose(values[near], full[near], atol=1e-6)
    assert np.mean(values == full) < 0.9
    short = run(body, grid, 0.0312, width=0.12, capacity=40)
    assert short.result == RESULTS.capacity_exceeded
    assert int(short.required_bricks) > 40
    with pytest.raises(GeometryError, match="finite Lipschitz constant"):
        jf.sample_near_surface(lambda p: jnp.sum(p), grid, capacity=9)


def test_a_rotation_vector_is_no_matrix():
    for given in (np.array([1.5, 0.0, 0.0]), np.eye(2), np.eye(4)):
        with pytest.raises(GeometryError, match="rotation_exp"):
            jf.Sphere(1.0).rotate(given)
