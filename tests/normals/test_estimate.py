"""Normals and noise levels of known surfaces; gradients; degenerate neighborhoods."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import GeometryError
from jaxgeom.normals import estimate, plane_residual
from jaxgeom.shapes import PointCloud


def _sphere(n, seed=0, dtype=np.float32):
    unit = np.random.default_rng(seed).normal(size=(n, 3))
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    return unit.astype(dtype)


def test_normals_of_a_sphere():
    unit = _sphere(3000)
    normals = jax.jit(estimate)(PointCloud(2.5 * unit + [7, -3, 1])).normals
    np.testing.assert_allclose(jnp.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert np.abs((np.asarray(normals) * unit).sum(axis=1)).min() > 0.98


@pytest.mark.slow
def test_the_error_falls_with_the_spacing():
    angles, run = [], jax.jit(lambda c: estimate(c, k=12).normals)
    for n in (1000, 4000):
        unit = _sphere(n)
        dots = (np.asarray(run(PointCloud(unit))) * unit).sum(1)
        angles.append(np.sqrt(np.mean(1 - np.abs(dots))))
    assert angles[0] / angles[1] > 1.6


def test_residual_measures_noise():
    rng = np.random.default_rng(1)
    noise, k = 0.003, 24
    points = rng.uniform(0, 1, (4000, 3)) * [3, 2, 0]
    points[:, 2] = rng.normal(0, noise, 4000)
    residual = jax.jit(lambda c: plane_residual(c, k=k))(PointCloud(points))
    rms = float(jnp.sqrt(jnp.mean(residual**2)))
    np.testing.assert_allclose(rms, noise * np.sqrt(1 - 3 / k), rtol=0.05)


@pytest.mark.slow
def test_padding_changes_nothing():
    unit = _sphere(500)
    mask = np.arange(640) < 500
    padded = np.concatenate([unit, np.full((140, 3), np.nan, np.float32)])
    run = jax.jit(estimate)
    both = run(PointCloud(unit)), run(PointCloud(padded, mask=mask))
    dots = (both[0].normals * both[1].normals[:500]).sum(axis=1)
    np.testing.assert_allclose(np.abs(dots), 1, atol=1e-5)
    assert (both[1].normals[500:] == 0).all()


def test_lines_and_single_places_have_no_normal():
    line = np.linspace(0, 1, 40)[:, None] * np.array([[1.0, 2, 3]])
    run = jax.jit(lambda c: estimate(c, k=8))
    for points in (line, np.full((40, 3), 1.5), line[:2]):
        out = run(PointCloud(points.astype(np.float32)))
        assert (out.normals == 0).all()


@pytest.mark.slow
def test_gradients(x64):
    points = jnp.asarray(_sphere(300, dtype=np.float64)) * jnp.asarray([1, 2, 0.7])
    fixed = jax.jit(lambda c: estimate(c, k=10).normals)(PointCloud(points))

    def loss(points):
        normals = estimate(PointCloud(points), k=10).normals
        normals = normals * jnp.sign(jnp.sum(normals * fixed, axis=1, keepdims=True))
        residual = plane_residual(PointCloud(points), k=10)
        return jnp.sum(jnp.sin(normals @ jnp.asarray([1.0, 2, 3]))) + residual.sum()

    value = jax.jit(loss)
    slope = jax.jit(jax.grad(loss))(points)
    way = jax.random.normal(jax.random.key(2), points.shape)
    numeric = (value(points + 1e-6 * way) - value(points - 1e-6 * way)) / 2e-6
    np.testing.assert_allclose(jnp.sum(slope * way), numeric, rtol=1e-5)


def test_the_gradient_is_finite_where_the_normal_is_not_unique():
    x = jnp.arange(4.0)
    lattice = jnp.stack(jnp.meshgrid(x, x, x), axis=-1).reshape(-1, 3)
    loss = lambda p: jnp.sum(estimate(PointCloud(p), k=7).normals @ jnp.arange(3.0))
    slope = jax.jit(jax.grad(loss))
    for points in (lattice, jnp.zeros_like(lattice)):
        assert jnp.isfinite(slope(points)).all()


SHARED = """
import sys
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec as P
from jaxgeom.neighbors import BruteForce
from jaxgeom.normals import estimate
from jaxgeom.shapes import PointCloud

jax.config.update("jax_enable_x64", True)
mesh = Mesh(np.asarray(jax.devices()), ("part",))
points = np.random.default_rng(0).normal(size=(101, 3))
mask = np.arange(101) % 7 != 0

def alone(points, backend, axis=None):
    cloud = PointCloud(points, mask=mask)
    return estimate(cloud, k=9, backend=backend, axis=axis).normals

def shared(points, backend):
    run = lambda p: alone(p, backend, "part")
    whole = dict(in_specs=P(), out_specs=P(), check_vma=False)
    return jax.shard_map(run, mesh=mesh, **whole)(points)

def both(run):
    def weighed(points, backend):
        normals = run(points, backend)
        return jnp.sum(jnp.sin(normals @ jnp.asarray([1.0, 2, 3])) ** 2), normals

    slope, normals = jax.jit(jax.grad(weighed, has_aux=True), static_argnums=1)(
        points, None)
    return slope, normals, jax.jit(run, static_argnums=1)(points, BruteForce())

np.savez(sys.argv[1], *both(alone), *both(shared))
"""


@pytest.mark.parametrize("count", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_devices_share_the_work(on_devices, count):
    """Three are no divisor of the points, nor of the leaves of their tree."""
    found = [*on_devices(SHARED, count).values()]
    assert np.abs(found[0]).max() > 0.1
    for alone, shared in zip(found[:3], found[3:], strict=True):
        np.testing.assert_allclose(shared, alone, atol=1e-13)


def test_an_axis_without_devices_is_an_error():
    with pytest.raises(GeometryError, match=r"jax.shard_map .* 'part'"):
        estimate(PointCloud(_sphere(20)), axis="part")
