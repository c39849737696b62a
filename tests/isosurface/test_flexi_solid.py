"""The inside of FlexiCubes as tetrahedra: its boundary, its volume, its derivatives."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import GeometryError, Grid
from jaxgeom.isosurface import (
    Centers,
    Diagonals,
    FlexiWeights,
    flexicubes,
    flexicubes_solid,
)
from jaxgeom.shapes import TetrahedralMesh

N = 9
SHAPE = (N, N, N)
GRID = Grid(jnp.array([-1.0, 2.0, 0.5]), jnp.array([0.3, 0.2, 0.25]), SHAPE)
SIDES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def _noise(seed):
    """White noise inside of a layer that is outside."""
    values = np.ones(SHAPE)
    inner = np.random.default_rng(seed).normal(size=(N - 2,) * 3)
    values[(slice(1, -1),) * 3] = inner
    return jnp.asarray(values)


def _weights(seed, size=1.0):
    rng = np.random.default_rng(seed)
    drawn = lambda x: jnp.asarray(size * rng.normal(size=x.shape))
    return jax.tree.map(drawn, FlexiWeights.zeros(SHAPE))


def _sums(triangles):
    """The sum of the orientations of every triangle where it is not zero, and how often
    one occurs at most."""
    order = np.argsort(triangles, axis=1)
    a, b, c = order.T
    turns = (a > b).astype(int) + (a > c) + (b > c)
    keys = np.take_along_axis(np.asarray(triangles), order, axis=1)
    found, which, counts = np.unique(
        keys, axis=0, return_inverse=True, return_counts=True
    )
    total = np.bincount(which.reshape(-1), 1 - 2 * (turns % 2), len(found))
    some = total != 0
    return dict(zip(map(tuple, found[some]), total[some], strict=True)), counts.max()


def _volumes(mesh):
    a, b, c, d = np.moveaxis(np.asarray(mesh.vertices)[mesh.tetrahedra], 1, 0)
    return np.sum(np.cross(b - a, c - a) * (d - a), axis=1) / 6


@eqx.filter_jit
def _surface(values, grid, weights, capacity, split):
    out = flexicubes(values, grid, weights, capacity=capacity, split=split)
    return out.extraction.mesh


def _check(values, grid, weights, split):
    """The boundary is the surface, each inner side has two tetrahedra, the volume is
    what the surface encloses; returns both."""
    solid = flexicubes_solid(values, grid, weights, split=split)
    mesh = solid.mesh
    surface = _surface(values, grid, weights, solid.capacity, split).trim()
    around, most = _sums(mesh.tetrahedra[:, SIDES].reshape(-1, 3))
    assert most <= 2
    assert around == _sums(np.asarray(surface.faces))[0]
    first = mesh.vertices[: solid.num_surface]
    np.testing.assert_allclose(first, surface.vertices, atol=1e-12)
    a, b, c = np.moveaxis(np.asarray(surface.vertices)[surface.faces], 1, 0)
    enclosed = np.sum(np.cross(a, b) * c) / 6
    np.testing.assert_allclose(_volumes(mesh).sum(), enclosed, rtol=1e-9)
    return solid, surface


@pytest.mark.parametrize(
    "seed, split",
    [(0, Diagonals()), pytest.param(1, Centers(), marks=pytest.mark.slow)],
)
def test_white_noise_of_any_weights_is_filled(x64, seed, split):
    _check(_noise(seed), GRID, _weights(seed), split)


@pytest.mark.slow
@pytest.mark.parametrize("size, cases", [((2, 2, 2), 256), ((3, 2, 2), 300)])
def test_sign_patterns_are_filled(x64, size, cases):
    """All cases of a cell, and pairs of cells, amid outside and amid inside."""
    rng = np.random.default_rng(1)
    shape = tuple(n + 4 for n in size)
    grid, zero = Grid(jnp.zeros(3), jnp.ones(3), shape), FlexiWeights.zeros(shape)
    for case in range(cases):
        bits = case if cases == 256 else rng.integers(1 << np.prod(size))
        for amid in (1.0, -1.0):
            values = np.ones(shape)
            values[(slice(1, -1),) * 3] = amid
            signs = 1 - 2.0 * (bits >> np.arange(np.prod(size)) & 1)
            values[(slice(2, -2),) * 3] = signs.reshape(size)
            if (values < 0).any():
                _check(jnp.asarray(values), grid, zero, Diagonals())


@pytest.mark.slow
def test_no_tetrahedron_of_a_ball_is_turned_over(x64):
    from_center = GRID.index_of(GRID.nodes()) - 4.03
    values = jnp.linalg.norm(from_center, axis=-1) - 2.7
    solid, surface = _check(values, GRID, FlexiWeights.zeros(SHAPE), Centers())
    assert float(solid.mesh.volumes().min()) > 0
    np.testing.assert_allclose(solid.mesh.volumes(), _volumes(solid.mesh), atol=1e-12)
    boundary = solid.mesh.boundary()
    assert _sums(np.asarray(boundary.faces)) == _sums(np.asarray(surface.faces))


@pytest.mark.slow
def test_moved_vertices_and_their_derivatives(x64):
    """`moved` is the solid of other values as long as the signs stay."""
    values, weights = _noise(5), _weights(5, size=0.3)
    solid = flexicubes_solid(values, GRID, weights)
    again = solid.moved(values * 1.2, GRID, weights)
    whole = flexicubes_solid(values * 1.2, GRID, weights).mesh
    np.testing.assert_allclose(again.vertices, whole.vertices, atol=1e-12)
    np.testing.assert_array_equal(again.tetrahedra, whole.tetrahedra)
    rng = np.random.default_rng(6)
    at, eps = (values, weights), 1e-6
    ways = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), at)
    probe = jnp.asarray(rng.normal(size=len(solid.mesh.tetrahedra)))

    @jax.jit
    def told(values, weights):
        return probe @ solid.moved(values, GRID, weights).volumes()

    step = lambda s: told(*jax.tree.map(lambda x, way: x + s * way, at, ways))
    slopes = jax.jit(jax.grad(told, argnums=(0, 1)))(*at)
    slope = jax.tree.map(lambda g, way: jnp.sum(g * way), slopes, ways)
    difference = (step(eps) - step(-eps)) / (2 * eps)
    np.testing.assert_allclose(sum(jax.tree.leaves(slope)), difference, rtol=1e-6)


@pytest.mark.slow
def test_no_surface_bad_values_and_bad_shapes(x64):
    grid = Grid(jnp.zeros(3), jnp.ones(3), (3, 3, 3))
    assert flexicubes_solid(jnp.ones((3, 3, 3)), grid).mesh.tetrahedra.shape == (0, 4)
    values = _noise(1).at[4, 4, 4].set(jnp.nan)
    _check(values, GRID, _weights(1), Centers())
    with pytest.raises(GeometryError, match="shape"):
        flexicubes_solid(jnp.ones((3, 3, 4)), grid)
    with pytest.raises(GeometryError, match="must name vertices 0 to 3"):
        TetrahedralMesh(np.zeros((4, 3)), np.array([[0, 1, 2, 4]]))
