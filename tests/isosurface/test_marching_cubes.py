"""Positions, derivatives, transformations and statuses of marching cubes."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS, GeometryError, runtime_token
from jaxgeom.isosurface import (
    Capacity,
    Cubic,
    Linear,
    MarchingCubes,
    extract,
    marching_cubes,
)
from jaxgeom.shapes import Grid

SHAPE = (9, 7, 11)


def noise(seed=0, dtype=np.float32, shape=SHAPE):
    return np.random.default_rng(seed).standard_normal(shape).astype(dtype)


def ball_grid(n):
    """A box that is no cube, with a ball of radius 0.7 about (0.1, -0.2, 0.3) in it."""
    shape = (n, n + 3, n - 2)
    low, high = np.array([-0.8, -1.1, -0.5]), np.array([0.9, 0.7, 1.2])
    return Grid(low, (high - low) / (np.array(shape) - 1), shape)


CENTER = np.array([0.1, -0.2, 0.3])


def ball(point):
    """An implicit ball that is no distance: linear interpolation has an error."""
    return jnp.exp(jnp.sum((point - CENTER) ** 2)) - np.exp(0.49)


def radius_error(n, placement):
    mesh = extract(ball, ball_grid(n), method=MarchingCubes(placement)).mesh
    radii = np.linalg.norm(np.asarray(mesh.vertices) - CENTER, axis=1)
    return np.abs(radii - 0.7).max()


@pytest.mark.slow
@pytest.mark.parametrize(
    "placement, order",
    [(Linear(), 2), pytest.param(Cubic(), 4, marks=pytest.mark.slow)],
)
def test_order_of_convergence(x64, placement, order):
    sizes = (16, 31, 61)
    errors = [radius_error(n, placement) for n in sizes]
    for before, after, n in zip(errors[:-1], errors[1:], sizes[1:], strict=True):
        # Vertices keep 1/1000 of a cell from the nodes, whatever the order.
        clearance = 1.1e-3 * float(np.max(ball_grid(n).spacing))
        assert after < max(before / 2 ** (order - 0.4), clearance), errors


def test_ball_is_closed_outward_and_of_its_volume(x64, tools):
    mesh = extract(ball, ball_grid(31)).mesh
    tools.assert_closed(mesh)
    v, f = mesh.vertices.shape[0], mesh.faces.shape[0]
    assert v - 3 * f // 2 + f == 2
    np.testing.assert_allclose(tools.volume(mesh), 4 / 3 * np.pi * 0.343, rtol=0.02)
    outward = np.asarray(mesh.vertices) - CENTER
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.sum(outward * np.asarray(mesh.normals), axis=1).min() > 0.999


def test_vertices_and_faces_agree_with_skimage(tools):
    measure = pytest.importorskip("skimage.measure")
    grid = tools.grid_of((17, 20, 23))
    x, y, z = np.moveaxis(np.asarray(grid.nodes()), -1, 0)
    values = np.sin(2 * x) * np.cos(y) + np.sin(2 * y) * np.cos(3 * z) + 0.1
    mesh = extract(values.astype(np.float32), grid).mesh
    peer, faces, _, _ = measure.marching_cubes(
        values.astype(np.float32), 0.0, spacing=tuple(np.asarray(grid.spacing))
    )
    # Faces may differ: the peer resolves ambiguous cells by the values inside.
    assert mesh.vertices.shape == peer.shape
    assert abs(mesh.faces.shape[0] - faces.shape[0]) < 0.01 * faces.shape[0]
    order = lambda p: p[np.lexsort(np.round(p, 3).T)]
    ours = order(np.asarray(mesh.vertices))
    np.testing.assert_allclose(ours, order(peer + grid.origin), atol=2e-3)


def run(values, origin, spacing, level, placement, capacity):
    grid = Grid(origin, spacing, values.shape)
    return marching_cubes(values, grid, level, capacity=capacity, placement=placement)


@pytest.mark.parametrize("placement", [Linear(), Cubic()])
def test_derivatives_are_central_differences(x64, tools, placement):
    values = np.asarray(noise(4, np.float64, (5, 4, 6)))
    grid = tools.grid_of(values.shape, np.float64)
    capacity = Capacity(400, 600)
    weights = noise(5, np.float64, (2, 400, 3))

    @jax.jit
    def scalar(values, origin, spacing, level):
        mesh = run(values, origin, spacing, level, placement, capacity).mesh
        return jnp.sum(weights[0] * mesh.vertices + weights[1] * mesh.normals)

    at = (values, grid.origin, grid.spacing, np.float64(0.05))
    slopes = jax.jit(jax.grad(scalar, argnums=(0, 1, 2, 3)))(*at)
    for i, point in enumerate(at):
        along = np.asarray(noise(6 + i, np.float64, np.shape(point)))
        moved = lambda h, i=i, a=along: scalar(*at[:i], at[i] + h * a, *at[i + 1 :])
        h = 1e-7
        expected = (moved(h) - moved(-h)) / (2 * h)
        np.testing.assert_allclose(np.sum(slopes[i] * along), expected, rtol=2e-5)


def test_derivatives_are_finite_beside_ties_and_bad_samples(tools):
    values = np.round(noise(7)).astype(np.float32)
    values[3, 3, 3], values[5, 2, 7], values[1, 5, 4] = np.nan, np.inf, -np.inf
    grid = tools.grid_of(SHAPE)
    for placement in (Linear(), Cubic()):

        def scalar(values, placement=placement):
            capacity = Capacity(2000, 3000)
            mesh = run(values, *grid_parts(grid), 0.0, placement, capacity).mesh
            return jnp.sum(mesh.vertices**2) + jnp.sum(mesh.normals[:, 0])

        value, slope = jax.jit(jax.value_and_grad(scalar))(values)
        assert np.isfinite(value) and np.isfinite(slope).all()


def grid_parts(grid):
    return grid.origin, grid.spacing


def test_vmap_is_the_loop(tools):
    grid, capacity = tools.grid_of(SHAPE), Capacity(900, 1500)
    one = functools.partial(marching_cubes, grid=grid, capacity=capacity)
    batch = np.stack([noise(8), noise(9) + 1.5, np.ones(SHAPE, np.float32)])
    batched = jax.jit(lambda v, token: jax.vmap(lambda x: one(x, token=token))(v))(
        batch, runtime_token()
    )
    single = jax.jit(one)
    for i, values in enumerate(batch):
        expected = single(values)
        got = jax.tree.map(lambda x, i=i: x[i], batched)
        assert bool(got.result == expected.result)
        np.testing.assert_array_equal(got.mesh.faces, expected.mesh.faces)
        np.testing.assert_allclose(got.mesh.vertices, expected.mesh.vertices, atol=1e-6)
        np.testing.assert_allclose(got.mesh.normals, expected.mesh.normals, atol=1e-5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_dtype_follows_the_values(x64, tools, dtype):
    mesh = extract(noise(0, dtype), tools.grid_of(SHAPE, dtype)).mesh
    assert mesh.vertices.dtype == mesh.normals.dtype == dtype
    assert mesh.faces.dtype == np.int32


@pytest.mark.parametrize(
    "short",
    [pytest.param("vertices", marks=pytest.mark.slow), "faces", "cells"],
)
def test_overflow_is_told_and_leaves_a_valid_prefix(tools, short):
    values, grid = noise(10), tools.grid_of(SHAPE)
    full = extract(values, grid)
    sizes = {
        "vertices": int(full.required_vertices),
        "faces": int(full.required_faces),
        "cells": int(full.required_cells),
    }
    tight = {**sizes, short: sizes[short] * 2 // 3}
    out = marching_cubes(values, grid, capacity=Capacity(**tight))
    assert bool(out.result == RESULTS.capacity_exceeded)
    assert int(out.required_vertices) == sizes["vertices"]
    assert int(out.required_faces) == sizes["faces"]
    assert int(out.required_cells) == sizes["cells"]
    f, v = int(out.mesh.num_faces), tight["vertices"]
    assert 0 < f < sizes["faces"]
    np.testing.assert_array_equal(out.mesh.faces[:f], full.mesh.faces[:f])
    assert (np.asarray(out.mesh.faces[:f]) < v).all()
    assert (np.asarray(out.mesh.faces[f:]) == v).all()
    again = marching_cubes(values, grid, capacity=Capacity(**sizes))
    assert bool(again.result == RESULTS.successful)
    np.testing.assert_array_equal(again.mesh.faces, full.mesh.faces)


def test_bad_samples_count_as_outside(tools):
    values = noise(11)
    bad = (np.array([2, 4, 6]), np.array([3, 1, 5]), np.array([8, 2, 9]))
    values[bad] = np.nan, np.inf, -np.inf
    out = extract(values, tools.grid_of(SHAPE), closed=True)
    assert bool(out.result == RESULTS.nonfinite_input)
    assert np.isfinite(out.mesh.vertices).all() and np.isfinite(out.mesh.normals).all()
    tools.assert_closed(out.mesh)


def test_no_surface_is_told(tools):
    out = extract(np.ones(SHAPE, np.float32), tools.grid_of(SHAPE))
    assert bool(out.result == RESULTS.no_surface)
    assert out.mesh.vertices.shape == (0, 3) and out.mesh.faces.shape == (0, 3)


def test_errors_say_what_to_do(tools):
    with pytest.raises(GeometryError, match="values must have shape"):
        marching_cubes(noise(), tools.grid_of((9, 7, 12)), capacity=Capacity(9, 9))
    with pytest.raises(GeometryError, match="at least 1"):
        Capacity(9, 0)
    huge = Grid(np.zeros(3), np.ones(3), (1000, 1000, 1000))
    dense = jax.ShapeDtypeStruct(huge.shape, np.float32)
    with pytest.raises(GeometryError, match="2\\^31"):
        eqx.filter_eval_shape(marching_cubes, dense, huge, capacity=Capacity(9, 9))


def test_a_function_is_sampled(tools):
    grid = tools.grid_of(SHAPE)
    field = lambda p: jnp.sum(jnp.sin(p)) - 0.4
    values = jnp.sum(jnp.sin(grid.nodes()), -1) - 0.4
    ours, expected = extract(field, grid).mesh, extract(values, grid).mesh
    np.testing.assert_array_equal(ours.faces, expected.faces)
    np.testing.assert_allclose(ours.vertices, expected.vertices, atol=1e-4)
