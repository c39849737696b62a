"""FlexiCubes: both ways to split, derivatives to values and weights, a short fit."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.isosurface import (
    Capacity,
    Centers,
    Diagonals,
    DualMarchingCubes,
    FlexiCubes,
    FlexiWeights,
    extract,
    flexicubes,
    pad_outside,
)
from jaxgeom.shapes import Grid

from .hard_fields import SHAPE, noise

PADDED = (11, 9, 13)


def weights(seed, shape, dtype=np.float32):
    zeros = FlexiWeights.zeros(shape, dtype)
    leaves, tree = jax.tree.flatten(zeros)
    drawn = [noise(seed + i, leaf.shape, dtype) for i, leaf in enumerate(leaves)]
    return jax.tree.unflatten(tree, drawn)


def assert_matched(mesh):
    """Each directed edge once, and its opposite once; every vertex used."""
    faces, v = np.asarray(mesh.faces, np.int64), mesh.vertices.shape[0]
    np.testing.assert_array_equal(np.unique(faces), np.arange(v))
    a, b = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).T
    keys, counts = np.unique(a * v + b, return_counts=True)
    assert (counts == 1).all()
    np.testing.assert_array_equal(keys, np.unique(b * v + a))


@pytest.mark.parametrize("split", [Diagonals(), Centers()])
def test_manifold_with_any_weights(tools, split):
    grid = tools.grid_of(SHAPE)
    method = FlexiCubes(weights(3, PADDED), split)
    ties = np.random.default_rng(1).integers(-1, 2, SHAPE).astype(np.float32)
    for values in (noise(0), ties):
        out = extract(values, grid, method=method, closed=True)
        assert bool(out.result == RESULTS.successful)
        assert_matched(out.mesh)
        assert int(out.required_faces) == out.mesh.faces.shape[0]
        assert np.isfinite(out.mesh.vertices).all()


def test_weights_of_zero_give_dual_marching_cubes(tools):
    grid = tools.grid_of(SHAPE)
    one = extract(noise(2), grid, method=FlexiCubes(), closed=True).mesh
    two = extract(noise(2), grid, method=DualMarchingCubes(), closed=True).mesh
    np.testing.assert_allclose(one.vertices, two.vertices, atol=1e-5)
    assert one.faces.shape == two.faces.shape
    assert tools.volume(one) > 0


def test_derivatives_are_central_differences(x64, tools):
    values = noise(4, (5, 4, 6), np.float64)
    grid = tools.grid_of(values.shape, np.float64)
    random = noise(5, (700, 3), np.float64)

    @jax.jit
    def scalar(values, weights, origin, spacing, level):
        grid = Grid(origin, spacing, values.shape)
        out = flexicubes(
            values,
            grid,
            weights,
            level,
            capacity=Capacity(700, 1300),
            split=Centers(),
        )
        vertices = out.extraction.mesh.vertices
        return jnp.sum(random * vertices) + 3 * jnp.sum(out.deviation)

    start = weights(20, values.shape, np.float64)
    at = (values, start, grid.origin, grid.spacing, np.float64(0.05))
    slopes = jax.jit(jax.grad(scalar, argnums=(0, 1, 2, 3, 4)))(*at)
    leaves, tree = jax.tree.flatten(at)
    for i, (leaf, slope) in enumerate(
        zip(leaves, jax.tree.leaves(slopes), strict=True)
    ):
        along = noise(40 + i, np.shape(leaf), np.float64)
        put = lambda h, i=i, a=along: scalar(
            *jax.tree.unflatten(
                tree, [*leaves[:i], leaves[i] + h * a, *leaves[i + 1 :]]
            )
        )
        expected = (put(1e-6) - put(-1e-6)) / 2e-6
        assert np.abs(slope).max() > 0
        np.testing.assert_allclose(np.sum(slope * along), expected, rtol=2e-5)


def test_a_fit_moves_vertices_onto_the_edges_of_a_box(tools):
    """Weights alone, the values held: the mesh of a box gains its edges."""
    n = 12
    grid = Grid(
        np.float32([-1, -1.1, -0.9]), np.float32([2, 2.2, 1.9]) / (n - 1), (n,) * 3
    )
    half = jnp.array([0.55, 0.62, 0.5])
    box = lambda p: jnp.max(jnp.abs(p) - half)
    values = jax.vmap(jax.vmap(jax.vmap(box)))(grid.nodes())

    def loss(weights):
        out = flexicubes(
            values, grid, weights, capacity=Capacity(1200, 2400), split=Centers()
        )
        mesh = out.extraction.mesh
        miss = jnp.where(mesh.vertex_mask, jax.vmap(box)(mesh.vertices), 0.0)
        return jnp.mean(miss**2) + 1e-4 * jnp.mean(out.deviation)

    step = jax.jit(jax.value_and_grad(loss))
    weights = FlexiWeights.zeros(grid.shape, jnp.float32)
    first, _ = step(weights)
    for _ in range(40):
        value, slope = step(weights)
        weights = jax.tree.map(lambda w, s: w - 0.1 * jnp.sign(s), weights, slope)
    assert value < first / 4


def test_overflow_and_shapes_are_told(tools):
    values, grid = pad_outside(noise(6), tools.grid_of(SHAPE))
    zeros = FlexiWeights.zeros(PADDED, jnp.float32)
    out = jax.jit(flexicubes, static_argnames=("capacity", "split"))(
        values, grid, zeros, capacity=Capacity(1800, 6000, 900), split=Centers()
    ).extraction
    assert bool(out.result == RESULTS.capacity_exceeded)
    f = int(out.mesh.num_faces)
    assert f > 0 and (np.asarray(out.mesh.faces[:f]) < 1800).all()
    short = eqx.tree_at(lambda w: w.splits, zeros, zeros.splits[1:])
    with pytest.raises(GeometryError, match="weights.splits"):
        flexicubes(values, grid, short, capacity=Capacity(9, 9))
