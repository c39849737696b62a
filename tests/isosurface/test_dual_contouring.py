"""Sharp corners and edges, accuracy, and derivatives through a field."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS
from jaxgeom.fields import Box, Sphere, Torus
from jaxgeom.isosurface import (
    Capacity,
    DualContouring,
    MarchingCubes,
    dual_contouring,
    extract,
)
from jaxgeom.isosurface._cube import ambiguous_faces
from jaxgeom.isosurface._patch_tables import FLIPPED, NO_FACE, patch_tables
from jaxgeom.shapes import Grid
from jaxgeom.transforms import Rigid

SHAPE = (17, 14, 20)
HALF = np.array([0.55, 0.4, 0.7], np.float32)


def box_grid(dtype=np.float32):
    low, high = np.array([-1.0, -1.05, -0.95]), np.array([1.1, 0.9, 1.0])
    spacing = (high - low) / (np.array(SHAPE) - 1)
    return Grid(low.astype(dtype), spacing.astype(dtype), SHAPE)


def turn(seed):
    q = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    return (q * np.linalg.det(q)).astype(np.float32)


def test_facts_of_the_patch_table():
    tables = patch_tables()
    flipped = np.flatnonzero(tables.bridged != NO_FACE)
    assert len(flipped) == 36 and tables.width == 7
    assert all(len(ambiguous_faces(case)) == 1 for case in flipped)
    np.testing.assert_array_equal(tables.counts[flipped], 1)
    np.testing.assert_array_equal(tables.counts[FLIPPED + flipped], 2)
    np.testing.assert_array_equal(
        tables.counts[FLIPPED + flipped], tables.counts[255 - flipped]
    )


def _padded(points, size=4096):
    return np.pad(points, ((0, size - len(points)), (0, 0)))


# One program for all bodies of a kind.
field_at = jax.jit(lambda body, points: jax.vmap(body)(points))


@pytest.mark.slow
def test_corners_and_edges_of_turned_boxes(tools):
    """Every corner is met to 1/1000 cell, whichever cells see its planes."""
    grid = box_grid()
    signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    errors, cells_with_surface, off = {}, [], []
    for seed in range(6):
        half = np.float32(0.8) * HALF
        body = Box(half).transformed(Rigid(turn(seed), np.float32([0.05, -0.06, 0.03])))
        for method in (MarchingCubes(), DualContouring()):
            mesh = extract(body, grid, method=method).mesh
            tools.assert_closed(mesh)
            centers = np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(axis=1)
            misfit = np.abs(field_at(body, _padded(centers)))[: len(centers)].mean()
            errors.setdefault(type(method), []).append(misfit)
        corners = jax.vmap(body.world_from_field)((signs * half).astype(np.float32))
        values = np.asarray(field_at(body, grid.nodes().reshape(-1, 3)))
        inside = values.reshape(SHAPE) < 0
        for corner in np.asarray(corners):
            i, j, k = np.floor((corner - grid.origin) / grid.spacing).astype(int)
            cells_with_surface.append(inside[i : i + 2, j : j + 2, k : k + 2].any())
            gaps = np.linalg.norm(np.asarray(mesh.vertices) - corner, axis=1)
            off.append(gaps.min() / np.min(grid.spacing))
    assert max(off) < 1e-3
    # Cells of which all nodes are outside were among them.
    assert np.sum(cells_with_surface) <= len(off) - 5
    assert np.mean(errors[DualContouring]) < np.mean(errors[MarchingCubes]) / 10


# A size is a program: the sphere and the finest grid are left to the slow run.
@pytest.mark.parametrize(
    "body, sizes",
    [
        pytest.param(Torus(0.55, 0.25), (16, 31), marks=pytest.mark.slow),
        pytest.param(Torus(0.55, 0.25), (31, 61), marks=pytest.mark.slow),
        pytest.param(Sphere(0.7), (16, 31, 61), marks=pytest.mark.slow),
    ],
)
def test_order_of_convergence(x64, body, sizes):
    body = body.rotate(turn(2).astype(np.float64)).translate([0.03, -0.04, 0.02])
    errors = []
    for n in sizes:
        low, high = np.array([-0.95, -1.0, -0.9]), np.array([1.0, 0.9, 1.05])
        shape = (n, n + 3, n - 2)
        grid = Grid(low, (high - low) / (np.array(shape) - 1), shape)
        for field in (body, jax.vmap(jax.vmap(jax.vmap(body)))(grid.nodes())):
            mesh = extract(field, grid, method=DualContouring()).mesh
            points = np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(axis=1)
            errors.append(np.abs(jax.jit(jax.vmap(body))(points)).max())
    for before, after in zip(errors[:-2], errors[2:], strict=True):
        assert after < before / 2**1.6, errors


def test_derivatives_through_a_field(x64):
    """Parameters, grid and level move the vertices as differences say they do."""
    grid = box_grid(np.float64)
    weights = np.random.default_rng(0).standard_normal((1200, 3))

    @jax.jit
    def scalar(half, shift, radius, origin, level):
        moved = Grid(origin, grid.spacing, SHAPE)
        place = Rigid(turn(1).astype(np.float64), shift)
        ball = Sphere(radius).translate(jnp.array([0.4, 0.3, 0.5]))
        body = Box(half).transformed(place) - ball
        values = jax.vmap(jax.vmap(jax.vmap(body)))(moved.nodes())
        out = dual_contouring(
            values, moved, level, capacity=Capacity(1200, 2400), field=body
        )
        return jnp.sum(weights * out.mesh.vertices)

    at = (
        HALF.astype(np.float64),
        np.array([0.05, -0.06, 0.03]),
        np.float64(0.45),
        grid.origin,
        np.float64(0.013),
    )
    slopes = jax.jit(jax.grad(scalar, argnums=(0, 1, 2, 3, 4)))(*at)
    for i, point in enumerate(at):
        along = np.random.default_rng(i).standard_normal(np.shape(point))
        moved = lambda h, i=i, a=along: scalar(*at[:i], at[i] + h * a, *at[i + 1 :])
        expected = (moved(1e-7) - moved(-1e-7)) / 2e-7
        np.testing.assert_allclose(np.sum(slopes[i] * along), expected, rtol=1e-4)


@pytest.mark.slow
def test_a_field_that_leaves_the_grid_is_closed_half_a_cell_outside(tools):
    grid = box_grid()
    out = extract(Sphere(1.2), grid, method=DualContouring(), closed=True)
    assert bool(out.result == RESULTS.successful)
    tools.assert_closed(out.mesh)
    place = (np.asarray(out.mesh.vertices) - grid.origin) / grid.spacing
    assert place.min() > -1 and (place < np.array(SHAPE)).all()
    reach = np.linalg.norm(np.asarray(out.mesh.vertices), axis=1)
    within = ((place > 0) & (place < np.array(SHAPE) - 1)).all(axis=1)
    assert np.abs(reach[within] - 1.2).max() < 0.02


def test_regularization_keeps_vertices_near_their_mean():
    grid, body = box_grid(), Box(HALF).rotate(turn(0))
    values = jax.vmap(jax.vmap(jax.vmap(body)))(grid.nodes())

    @jax.jit
    def misfit(weight):
        out = dual_contouring(
            values,
            grid,
            capacity=Capacity(1200, 2400),
            field=body,
            regularization=weight,
        )
        miss = jnp.abs(jax.vmap(body)(out.mesh.vertices))
        return jnp.sum(jnp.where(out.mesh.vertex_mask, miss, 0.0))

    assert misfit(1e-2) < misfit(1e4) / 3
