"""The strongest predicate: closed, edge-manifold, oriented, on the worst of fields."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS
from jaxgeom.isosurface import (
    AsymptoticDecider,
    Capacity,
    Cubic,
    MarchingCubes,
    TrilinearDecider,
    count,
    extract,
    marching_cubes,
)
from jaxgeom.meshes import topology
from jaxgeom.shapes import Grid

# Each shape compiles its own programs: three of six are left to the slow run.
_SLOW = [
    pytest.param(shape, marks=pytest.mark.slow)
    for shape in ((2, 5, 33), (270, 3, 4), (5, 6, 64))
]
_QUICK = [(9, 7, 11), (2, 2, 2), (4, 3, 300)]
SHAPES = [*_QUICK, *_SLOW]


def noise(shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def ties(shape, seed=0):
    return np.random.default_rng(seed).integers(-1, 2, shape).astype(np.float32)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("field", [noise, ties])
def test_closed_after_padding(tools, shape, field):
    for level in (0.0, 0.5):
        out = extract(field(shape), tools.grid_of(shape), level, closed=True)
        assert out.result == RESULTS.successful
        tools.assert_closed(out.mesh)


@pytest.mark.parametrize(
    "decider",
    [pytest.param(AsymptoticDecider(), marks=pytest.mark.slow), TrilinearDecider()],
)
def test_closed_with_deciders_and_cubic_placement(tools, decider):
    method = MarchingCubes(placement=Cubic(), ambiguity=decider)
    for field, seed in itertools.product((noise, ties), range(6)):
        values = field((9, 7, 11), seed)
        out = extract(values, tools.grid_of(values.shape), method=method, closed=True)
        tools.assert_closed(out.mesh)


@jax.jit
def _euler_numbers(cell):
    """Of a cell by its faces, by tunnels too, and of its interpolant at 33^3 nodes."""
    fine = cell
    for axis in range(3):
        t = jnp.linspace(0, 1, 33).reshape([-1 if d == axis else 1 for d in range(3)])
        low, high = (jnp.take(fine, jnp.array([k]), axis) for k in (0, 1))
        fine = (1 - t) * low + t * high

    def euler(values, rule, capacity):
        grid = Grid(jnp.zeros(3), jnp.ones(3), values.shape)
        settings = dict(capacity=capacity, ambiguity=rule, normals=False)
        return topology(marching_cubes(values, grid, **settings).mesh).euler

    coarse, small = Capacity(12, 20), Capacity(16_000, 32_000)
    return jnp.stack(
        [
            euler(cell, AsymptoticDecider(), coarse),
            euler(cell, TrilinearDecider(), coarse),
            euler(fine, AsymptoticDecider(), small),
        ]
    )


@pytest.mark.slow
def test_the_topology_is_that_of_the_trilinear_interpolant():
    rng = np.random.default_rng(0)
    cells = np.exp(rng.standard_normal((1500, 2, 2, 2)))
    cells *= rng.choice([-1, 1], cells.shape)
    by_faces, both, true = jax.lax.map(_euler_numbers, jnp.float32(cells)).T
    np.testing.assert_array_equal(both, true)
    assert np.sum(by_faces != both) >= 10


def test_all_sign_patterns_of_a_cell(tools):
    grid = tools.grid_of((2, 2, 2))
    corners = np.arange(8).reshape(2, 2, 2).transpose(2, 1, 0)
    for case in range(1, 256):
        values = np.where(case >> corners & 1, -0.7, 0.4).astype(np.float32)
        tools.assert_closed(extract(values, grid, closed=True).mesh)


def test_all_sign_patterns_inside_a_grid(tools):
    """256 cells with outside nodes around them, in one field: no padding involved."""
    corners = np.arange(8).reshape(2, 2, 2).transpose(2, 1, 0)
    values = np.ones((64, 64, 4), np.float32)
    for case in range(256):
        x, y = 4 * (case // 16) + 1, 4 * (case % 16) + 1
        block = np.where(case >> corners & 1, -0.7, 0.4)
        values[x : x + 2, y : y + 2, 1:3] = block
    out = extract(values, tools.grid_of(values.shape))
    tools.assert_closed(out.mesh)


def test_open_only_at_the_sides_of_the_grid(tools):
    shape = (6, 7, 35)
    grid = tools.grid_of(shape)
    mesh = extract(noise(shape, 3), grid).mesh
    faces, v = np.asarray(mesh.faces, np.int64), mesh.vertices.shape[0]
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    keys, counts = np.unique(a * v + b, return_counts=True)
    assert (counts == 1).all()
    lonely = ~np.isin(a * v + b, b * v + a)
    place = (np.asarray(mesh.vertices) - grid.origin) / grid.spacing
    place = np.stack([place[a[lonely]], place[b[lonely]]])
    last = np.array(shape) - 1
    at_side = (np.abs(place) < 1e-4) | (np.abs(place - last) < 1e-4)
    assert lonely.any() and at_side.all(0).any(-1).all()


@pytest.mark.parametrize(
    "shape",
    [_QUICK[0], *(pytest.param(s, marks=pytest.mark.slow) for s in _QUICK[1:]), *_SLOW],
)
def test_count_is_exact(tools, shape):
    values = jnp.asarray(noise(shape, 1))
    needed = count(values, 0.2)
    inside = np.asarray(values) < np.float32(0.2)
    cut = [np.sum(np.diff(inside.astype(int), axis=d) != 0) for d in range(3)]
    assert int(needed.vertices) == sum(cut)
    bound = 5 * int(np.prod(np.array(shape) - 1))
    big = Capacity(sum(cut) + 1, bound, bound)
    out = marching_cubes(values, tools.grid_of(shape), 0.2, capacity=big)
    real = np.asarray(out.mesh.faces)[:, 0] < big.vertices
    assert real.sum() == int(needed.faces) == int(out.mesh.num_faces)
    assert real[: real.sum()].all()
    assert int(out.required_cells) == int(needed.cells) <= bound
