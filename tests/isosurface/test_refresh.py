"""A frozen topology under new values, and the shape derivative."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom._core import RESULTS
from jaxgeom.fields import Torus
from jaxgeom.isosurface import Capacity, follow, freeze, marching_cubes, refresh
from jaxgeom.meshes import volume
from jaxgeom.shapes import Grid, TriangleMesh

SHAPE = (9, 7, 11)
CAPACITY = Capacity(1200, 2000)


def noise(seed, shape=SHAPE):
    return np.random.default_rng(seed).standard_normal(shape)


def test_refresh_is_marching_cubes_while_the_topology_holds(x64, tools):
    """Values, and derivatives, of a batch of fields with the same signs."""
    grid = tools.grid_of(SHAPE, np.float64)
    base = np.sign(noise(0)) * (0.5 + np.abs(noise(1)))
    batch = base * (1 + 0.4 * np.tanh(noise(2, (3, *SHAPE))))
    frozen = jax.jit(lambda v: freeze(v, grid, capacity=CAPACITY))(base)
    again = jax.jit(jax.vmap(lambda v: refresh(frozen, v, grid)))(batch)
    run = lambda v: marching_cubes(v, grid, capacity=CAPACITY, normals=False)
    expected = jax.jit(jax.vmap(run))(batch)
    vertices, known = again.mesh.vertices, expected.mesh.vertices
    np.testing.assert_allclose(vertices, known, atol=1e-12)
    np.testing.assert_array_equal(again.mesh.faces, expected.mesh.faces)
    assert (again.result == RESULTS.successful).all()
    assert np.abs(vertices[0] - vertices[1]).max() > 0.01

    weights = noise(3, (1200, 3))
    scalar = jax.jit(
        lambda v: jnp.sum(weights * refresh(frozen, v, grid).mesh.vertices)
    )
    along = noise(4)
    slope = np.sum(jax.jit(jax.grad(scalar))(base) * along)
    difference = (scalar(base + 1e-6 * along) - scalar(base - 1e-6 * along)) / 2e-6
    np.testing.assert_allclose(slope, difference, rtol=1e-6)

    flipped = base.copy()
    flipped[4, 3, 5] *= -1
    out = refresh(frozen, flipped, grid)
    assert bool(out.result == RESULTS.no_surface)


def test_follow_converges_to_the_slope_of_the_volume(x64):
    """V = 2 pi^2 R r^2 of a torus, to second order in the spacing of the grid."""
    major, minor = 0.62, 0.27
    errors = []
    for n in (13, 25):
        low, high = np.array([-1.1, -1.0, -0.5]), np.array([1.0, 1.05, 0.55])
        grid = Grid(low, (high - low) / (n - 1), (n, n, n))
        values = jax.vmap(jax.vmap(jax.vmap(Torus(major, minor))))(grid.nodes())
        run = lambda v, grid=grid: marching_cubes(
            v, grid, capacity=Capacity(4000, 8000)
        )
        mesh = jax.jit(run)(values).mesh
        size = lambda a, b, mesh=mesh: volume(follow(mesh, Torus(a, b)))
        slopes = np.array(jax.jit(jax.grad(size, argnums=(0, 1)))(major, minor))
        known = 2 * np.pi**2 * np.array([minor**2, 2 * major * minor])
        errors.append(np.abs(slopes / known - 1))
    assert (errors[1] < errors[0] / 2**1.6).all(), errors


def test_follow_is_the_root_along_the_normal(x64):
    bent = lambda p, q: jnp.exp(q[0] * jnp.sum(p * p)) - jnp.exp(q[1]) + q[2] * p[0]
    q = np.array([1.1, 0.4, 0.2])
    start = noise(5, (40, 3))
    root = lambda q, x, n: jax.lax.fori_loop(
        0,
        30,
        lambda _, s: s - bent(x + s * n, q) / jnp.dot(jax.grad(bent)(x + s * n, q), n),
        0.0,
    )
    unit = start / np.linalg.norm(start, axis=1, keepdims=True)
    lengths = jax.vmap(root, (None, 0, 0))(q, 0.5 * unit, unit)
    points = 0.5 * unit + lengths[:, None] * unit
    faces = np.array([[0, 1, 2]], np.int32)
    surface = TriangleMesh(points, faces)
    along = np.array([0.3, -0.5, 0.7])
    moved = lambda q: follow(surface, lambda p: bent(p, q)).vertices
    _, speed = jax.jvp(moved, (q,), (along,))
    slopes = jax.vmap(jax.grad(bent), (0, None))(points, q)
    normals = slopes / jnp.linalg.norm(slopes, axis=1, keepdims=True)
    step = lambda h: jax.vmap(root, (None, 0, 0))(q + h * along, points, normals)
    difference = ((step(1e-6) - step(-1e-6)) / 2e-6)[:, None] * normals
    np.testing.assert_allclose(speed, difference, atol=1e-7)
    np.testing.assert_array_equal(moved(q), points)
