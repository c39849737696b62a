"""Dual contouring on an octree, and marching cubes on the feature-aligned dual grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom.fields import Box, Cylinder
from jaxgeom.isosurface import (
    AdaptiveDualContouring,
    Capacity,
    DualContouring,
    DualGridCubes,
    MarchingCubes,
    extract,
)
from jaxgeom.isosurface._graph_fit import feature, of_blocks, of_cells
from jaxgeom.meshes import topology
from jaxgeom.shapes import Grid
from jaxgeom.transforms import Rigid

from .hard_fields import SHAPE, noise, sheets, ties

HALF = np.array([0.55, 0.4, 0.7])
METHODS = [AdaptiveDualContouring(0.3, levels=3), DualGridCubes(0.3, levels=2)]
NAMES = {"ids": lambda m: type(m).__name__}


def turned(body, dtype=np.float32):
    q = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    turn = (q * np.linalg.det(q)).astype(dtype)
    return body.transformed(Rigid(turn, np.array([0.05, -0.06, 0.03], dtype)))


def body_grid(shape, dtype=np.float32):
    low, high = np.array([-1.0, -1.05, -0.95]), np.array([1.1, 0.9, 1.0])
    spacing = (high - low) / (np.array(shape) - 1)
    return Grid(low.astype(dtype), spacing.astype(dtype), shape)


# Capacities are programs, which take long to compile.
FIELDS = [
    pytest.param("noise", (noise(0),), marks=pytest.mark.slow),
    pytest.param("all", (noise(1), ties(0), ties(1), sheets()), marks=pytest.mark.slow),
]


@pytest.mark.parametrize("_, fields", FIELDS)
def test_merging_keeps_the_topology_of_the_worst_fields(tools, _, fields):
    """With any tolerance the same components, handles and closed manifold."""
    grid, before, after = tools.grid_of(SHAPE), 0, 0
    for values in fields:
        fine = extract(values, grid, method=DualContouring(), closed=True).mesh
        method = AdaptiveDualContouring(1e9, levels=3)
        mesh = extract(values, grid, method=method, closed=True).mesh
        tools.assert_closed(mesh)
        old, new = topology(fine), topology(mesh)
        assert old.euler == new.euler and old.num_components == new.num_components
        assert bool(new.is_manifold)
        before, after = before + fine.faces.shape[0], after + mesh.faces.shape[0]
    assert after < 0.9 * before


@pytest.mark.slow
def test_flat_parts_of_a_sharp_body_get_large_faces(tools):
    """Both octrees: few faces, still sharp; a larger tolerance gives fewer."""
    body = turned(Box(HALF.astype(np.float32)) - Cylinder(0.2, 1.5))
    grid = body_grid((33, 30, 35))
    cell = float(np.max(grid.spacing))
    dense = extract(body, grid, method=MarchingCubes()).mesh
    genus = topology(dense).genus
    off = lambda mesh: np.abs(jax.vmap(body)(_centers(mesh))).mean()
    for make in (AdaptiveDualContouring, DualGridCubes):
        fine, coarse = (
            extract(body, grid, method=make(t * cell, levels=3)).mesh
            for t in (0.02, 0.1)
        )
        for mesh in (fine, coarse):
            tools.assert_closed(mesh)
            assert topology(mesh).genus == genus
        few, some, many = (m.faces.shape[0] for m in (coarse, fine, dense))
        assert few < some < many and few < many / 2
        assert off(fine) < off(dense)


def _centers(mesh):
    return np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(axis=1)


@pytest.mark.slow
def test_vertices_keep_the_tolerance():
    """A vertex is near the planes of its part: on a ball, near the ball."""
    ball = turned(Cylinder(0.6, 0.8))
    grid = body_grid((33, 30, 35))
    for tolerance in (0.004, 0.02):
        method = AdaptiveDualContouring(tolerance, levels=3)
        mesh = extract(ball, grid, method=method).mesh
        assert np.abs(jax.vmap(ball)(mesh.vertices)).max() < 2 * tolerance


@pytest.mark.slow
def test_dual_grid_finds_edges_and_sheets_between_nodes(tools):
    grid = body_grid((33, 30, 35))
    body = turned(Box(HALF.astype(np.float32)))
    dense = extract(body, grid, method=MarchingCubes()).mesh
    mesh = extract(body, grid, method=DualGridCubes()).mesh
    tools.assert_closed(mesh)
    off = [np.abs(jax.vmap(body)(_centers(m))).mean() for m in (dense, mesh)]
    assert off[1] < off[0] / 10
    thin = turned(Box(np.array([0.6, 0.5, 0.008], np.float32)))
    # The sheet has a third of the width of a cell: its sides are not resolved.
    broken = extract(thin, grid, method=MarchingCubes()).mesh
    whole = extract(thin, grid, method=DualGridCubes()).mesh
    tools.assert_closed(whole)
    assert topology(broken).num_components > 1 or broken.faces.shape[0] == 0
    assert topology(whole).num_components == 1 and topology(whole).genus == 0


def test_moments_are_those_of_all_planes(x64):
    """Cells and blocks of cells, against sums over their planes; compiled or not."""
    values, slopes = noise(0, (5, 5, 6), float), noise(1, (3, 5, 5, 6), float)
    size = np.array([1.0, 0.8, 0.7])
    both = lambda v, s: (of_cells(v, s, size), of_blocks(of_cells(v, s, size), size))
    for run in (both, jax.jit(both)):
        cells, blocks = run(values, slopes)
        for moments, at, first, width in (
            (cells, (1, 2, 3), (1, 2, 3), 1),
            (blocks, (0, 1, 1), (0, 2, 2), 2),
        ):
            expected = _sums(values, slopes, size, first, width)
            found = [getattr(moments, n)[(..., *at)] for n in expected]
            for a, b in zip(found, expected.values(), strict=True):
                np.testing.assert_allclose(a, b, atol=1e-12)


def _sums(values, slopes, size, first, width):
    center, rows = (np.array(first) + width / 2) * size, []
    for part in np.ndindex(width, width, width):
        for corner in np.ndindex(2, 2, 2):
            node = tuple(np.add(np.add(first, part), corner))
            g = slopes[(slice(None), *node)]
            height = values[node] - g @ (np.array(node) * size - center)
            rows.append((1 / (1 + g @ g), *g, height))
    rows = np.array(rows)
    weight, planes = rows[:, 0], rows[:, 1:]
    mean = weight @ planes / weight.sum()
    cov = (weight[:, None] * (planes - mean)).T @ (planes - mean) / weight.sum()
    normal = cov[:3, :3][np.triu_indices(3)]
    return {
        "weight": weight.sum(),
        "slope": mean[:3],
        "height": mean[3],
        "normal": normal,
        "right": cov[:3, 3],
        "spread": cov[3, 3],
    }


def test_a_feature_is_where_the_planes_meet(x64):
    """Three planes meet in a line of points and heights: it ends on that line."""
    slopes_of = np.array([[0.8, 0.1, -0.2], [-0.3, 0.9, 0.4], [0.2, -0.5, 0.7]])
    apex, size = np.array([0.45, 0.4, 0.55]), np.array([1.0, 0.8, 0.7])
    nodes = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), axis=-1) * size
    heights = np.einsum("pd,xyzd->pxyz", slopes_of, nodes - apex * size)
    which = heights.argmax(axis=0)
    slopes = np.moveaxis(slopes_of[which], -1, 0)
    moments = of_cells(jnp.asarray(heights.max(axis=0)), jnp.asarray(slopes), size)
    off, error = feature(moments, size, 1e-6)
    assert len(np.unique(which)) == 3
    there = slopes_of @ (off.ravel() + (0.5 - apex) * size)
    np.testing.assert_allclose(there - there.mean(), 0, atol=1e-5)
    assert np.ptp(slopes_of @ ((0.5 - apex) * size)) > 0.02 and error.item() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS, **NAMES)
def test_derivatives_are_central_differences(x64, method):
    grid = body_grid((7, 6, 8), np.float64)
    weights = noise(5, (400, 3), np.float64)

    @jax.jit
    def scalar(half, origin, level):
        moved = Grid(origin, grid.spacing, grid.shape)
        body = turned(Box(half), np.float64)
        values = jax.vmap(jax.vmap(jax.vmap(body)))(moved.nodes())
        out = method(values, moved, level, capacity=Capacity(400, 800), field=body)
        return jnp.sum(weights * out.mesh.vertices)

    at = (HALF, grid.origin, np.float64(0.013))
    slopes = jax.jit(jax.grad(scalar, argnums=(0, 1, 2)))(*at)
    for i, point in enumerate(at):
        along = np.random.default_rng(i).standard_normal(np.shape(point))
        moved = lambda h, i=i, a=along: scalar(*at[:i], at[i] + h * a, *at[i + 1 :])
        expected = (moved(1e-7) - moved(-1e-7)) / 2e-7
        np.testing.assert_allclose(np.sum(slopes[i] * along), expected, rtol=1e-4)
