"""Laws of all dual extractors: closed, edge-manifold, oriented, on the worst of fields,
with derivatives, statuses and batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.isosurface import (
    AdaptiveDualContouring,
    Capacity,
    DualContouring,
    DualGridCubes,
    DualMarchingCubes,
    extract,
    pad_outside,
)
from jaxgeom.shapes import Grid

from .hard_fields import SHAPE, blocks, noise, sheets, ties

METHODS = [DualContouring(), DualMarchingCubes()]
# Topology is the same code for both: one of them will do by default.
SHARED = [pytest.param(DualContouring(), marks=pytest.mark.slow), DualMarchingCubes()]
# The octrees keep all laws but the exact numbers of vertices and faces.
OCTREES = [
    pytest.param(AdaptiveDualContouring(0.3, levels=3), marks=pytest.mark.slow),
    pytest.param(DualGridCubes(0.3, levels=2), marks=pytest.mark.slow),
    pytest.param(DualGridCubes(), marks=pytest.mark.slow),
]
# Each capacity compiles its own program: one of three is left to the slow run.
SHORT = [0, 1, pytest.param(2, marks=pytest.mark.slow)]


@pytest.mark.parametrize("method", SHARED + OCTREES, ids=lambda m: type(m).__name__)
def test_closed_after_padding(tools, method):
    grid = tools.grid_of(SHAPE)
    for values in (noise(0), noise(1), ties(0), ties(1), ties(2), sheets()):
        for level in (0.0, 0.5):
            out = extract(values, grid, level, method=method, closed=True)
            assert out.result == RESULTS.successful
            tools.assert_closed(out.mesh)
            if method in (DualContouring(), DualMarchingCubes()):
                assert int(out.required_faces) == out.mesh.faces.shape[0]


@pytest.mark.parametrize("method", SHARED + OCTREES, ids=lambda m: type(m).__name__)
def test_all_sign_patterns(tools, method):
    """The 4096 of 3x2x2 nodes hold the 256 of 2x2x2: those with a side outside."""
    values = blocks((3, 2, 2))
    tools.assert_closed(
        extract(values, tools.grid_of(values.shape), method=method).mesh
    )


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_vertices_lie_in_their_cells(tools, method):
    """Sides of quads join cells that share a face: they span at most two cells."""
    mesh = extract(noise(3), tools.grid_of(SHAPE), method=method, closed=True).mesh
    grid = tools.grid_of(SHAPE)
    cells = np.floor((np.asarray(mesh.vertices) - grid.origin) / grid.spacing)
    steps = np.abs(cells[mesh.faces] - cells[np.roll(mesh.faces, 1, axis=1)])
    assert steps.max() == 1 and (steps.sum(-1) <= 2).all()


@pytest.mark.parametrize("method", SHARED, ids=lambda m: type(m).__name__)
def test_open_only_along_the_sides_of_the_grid(tools, method):
    grid = tools.grid_of(SHAPE)
    mesh = extract(noise(3), grid, method=method).mesh
    faces, v = np.asarray(mesh.faces, np.int64), mesh.vertices.shape[0]
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    keys, counts = np.unique(a * v + b, return_counts=True)
    assert (counts == 1).all()
    lonely = ~np.isin(a * v + b, b * v + a)
    place = (np.asarray(mesh.vertices) - grid.origin) / grid.spacing
    cells = np.floor(np.stack([place[a[lonely]], place[b[lonely]]]))
    at_side = (cells == 0) | (cells == np.array(SHAPE) - 2)
    assert lonely.any() and at_side.all(0).any(-1).all()


@pytest.mark.parametrize("method", SHARED, ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("short", SHORT)
def test_overflow_is_told_and_leaves_valid_faces(tools, method, short):
    values, grid = noise(10), tools.grid_of(SHAPE)
    full = extract(values, grid, method=method, closed=True)
    padded, grid = pad_outside(values, grid)
    sizes = [full.required_vertices, full.required_faces, full.required_cells]
    tight = [int(s) for s in sizes]
    tight[short] = tight[short] * 2 // 3
    out = jax.jit(method, static_argnames="capacity")(
        padded, grid, 0.0, capacity=Capacity(*tight)
    )
    assert bool(out.result == RESULTS.capacity_exceeded)
    assert int(out.required_faces) == full.mesh.faces.shape[0]
    assert int(out.required_vertices) >= full.mesh.vertices.shape[0]
    f, v = int(out.mesh.num_faces), tight[0]
    assert 0 < f < full.mesh.faces.shape[0]
    assert (np.asarray(out.mesh.faces[:f]) < v).all()
    assert (np.asarray(out.mesh.faces[f:]) == v).all()
    named = np.unique(out.mesh.faces[:f])
    kept, known = np.asarray(out.mesh.vertices), np.asarray(full.mesh.vertices)
    np.testing.assert_allclose(kept[named], known[named], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("method", SHARED + OCTREES, ids=lambda m: type(m).__name__)
def test_vmap_is_the_loop(tools, method):
    grid, capacity = tools.grid_of(SHAPE), Capacity(1100, 2600)
    one = lambda values: method(values, grid, capacity=capacity)
    batch = np.stack([noise(8), noise(9) + 1.5, np.ones(SHAPE, np.float32)])
    batched = jax.jit(jax.vmap(one))(batch)
    for i, values in enumerate(batch):
        expected = extract(values, grid, method=method)
        got = jax.tree.map(lambda x, i=i: x[i], batched)
        assert bool(got.result == expected.result)
        mesh = got.mesh.trim()
        np.testing.assert_array_equal(mesh.faces, expected.mesh.faces)
        # Fits of planes are solved to the rounding of coordinates over their weight.
        near = 5e-7 / 0.01
        np.testing.assert_allclose(mesh.vertices, expected.mesh.vertices, atol=near)


@pytest.mark.parametrize("method", SHARED + OCTREES, ids=lambda m: type(m).__name__)
def test_statuses_and_bad_samples(tools, method):
    grid, values = tools.grid_of(SHAPE), noise(11)
    values[[2, 4, 6], [3, 1, 5], [8, 2, 9]] = np.nan, np.inf, -np.inf
    out = extract(values, grid, method=method, closed=True)
    assert bool(out.result == RESULTS.nonfinite_input)
    assert np.isfinite(out.mesh.vertices).all()
    tools.assert_closed(out.mesh)
    out = extract(np.ones(SHAPE, np.float32), grid, method=method)
    assert bool(out.result == RESULTS.no_surface) and out.mesh.faces.shape == (0, 3)
    with pytest.raises(GeometryError, match="values must have shape"):
        method(noise(), tools.grid_of((9, 7, 12)), capacity=Capacity(9, 9))


@pytest.mark.parametrize("method", SHARED, ids=lambda m: type(m).__name__)
def test_derivatives_are_central_differences(x64, tools, method):
    values = noise(4, (5, 4, 6), np.float64)
    grid = tools.grid_of(values.shape, np.float64)
    weights = noise(5, (400, 3), np.float64)

    @jax.jit
    def scalar(values, origin, spacing, level):
        grid = Grid(origin, spacing, values.shape)
        out = method(values, grid, level, capacity=Capacity(400, 600))
        return jnp.sum(weights * out.mesh.vertices)

    at = (values, grid.origin, grid.spacing, np.float64(0.05))
    slopes = jax.jit(jax.grad(scalar, argnums=(0, 1, 2, 3)))(*at)
    for i, point in enumerate(at):
        along = np.asarray(noise(6 + i, np.shape(point), np.float64))
        moved = lambda h, i=i, a=along: scalar(*at[:i], at[i] + h * a, *at[i + 1 :])
        expected = (moved(1e-7) - moved(-1e-7)) / 2e-7
        np.testing.assert_allclose(np.sum(slopes[i] * along), expected, rtol=2e-5)


@pytest.mark.parametrize("method", SHARED, ids=lambda m: type(m).__name__)
def test_derivatives_are_finite_beside_ties_and_bad_samples(tools, method):
    values = ties(7)
    values[3, 3, 3], values[5, 2, 7], values[1, 5, 4] = np.nan, np.inf, -np.inf

    def scalar(values):
        out = method(values, tools.grid_of(SHAPE), capacity=Capacity(900, 2600))
        return jnp.sum(out.mesh.vertices**2)

    value, slope = jax.jit(jax.value_and_grad(scalar))(values)
    assert np.isfinite(value) and np.isfinite(slope).all()
