"""Lines in the plane: closed, in order, inside to the left, with derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.isosurface import marching_squares

SHAPE = (17, 12)
ORIGIN, SPACING = np.array([0.3, -1.2]), np.array([0.5, 0.8])
CAPACITY = 400

run = jax.jit(marching_squares, static_argnames="capacity")


def noise(seed, shape=SHAPE):
    return np.random.default_rng(seed).standard_normal(shape)


def rimmed(values):
    """The values with outside nodes at the sides."""
    return np.pad(values[1:-1, 1:-1], 1, constant_values=1.0)


def area(out):
    """The area to the left of closed lines."""
    n = int(out.num_points)
    p = np.asarray(out.points)[:n]
    q = p[np.asarray(out.following)[:n]]
    return np.sum(p[:, 0] * q[:, 1] - q[:, 0] * p[:, 1]) / 2


def assert_in_order(out):
    """Lines are contiguous, and each point is followed by the next of its line."""
    n, following = int(out.num_points), np.asarray(out.following)
    line = np.asarray(out.line)
    assert (line[n:] == len(line)).all() and (following[n:] == len(line)).all()
    line, following = line[:n], following[:n]
    assert (np.diff(line) >= 0).all() and (np.diff(line) <= 1).all()
    assert n == 0 or line[-1] == int(out.num_lines) - 1
    last = np.append(np.diff(line) > 0, True)
    np.testing.assert_array_equal(following[~last], np.arange(n)[~last] + 1)
    first = np.searchsorted(line, line)
    closes = following[last] == first[last]
    assert (closes | (following[last] == CAPACITY)).all()
    return closes


@pytest.mark.parametrize("seed", range(4))
def test_closed_lines_around_the_inside(x64, seed):
    values = rimmed(noise(seed))
    if seed % 2:
        values = np.round(values)
    out = run(values, ORIGIN, SPACING, capacity=CAPACITY)
    assert bool(out.result == RESULTS.successful)
    assert assert_in_order(out).all()
    cut = sum(np.sum(np.diff((values < 0).astype(int), axis=a) != 0) for a in (0, 1))
    assert int(out.num_points) == int(out.required_points) == cut
    assert area(out) > 0
    # Nodes are inside exactly where the lines wind around them.
    p = np.asarray(out.points)[:cut]
    q = p[np.asarray(out.following)[:cut]]
    i, j = np.indices(SHAPE)
    nodes = ORIGIN + SPACING * np.stack([i, j], axis=-1)
    a, b = (x - nodes[..., None, :] for x in (p, q))
    turn = np.arctan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(-1))
    winding = np.round(turn.sum(-1) / (2 * np.pi)).astype(int)
    np.testing.assert_array_equal(winding, values < 0)


def test_lines_end_at_the_sides_only(x64):
    out = run(noise(7), ORIGIN, SPACING, 0.1, capacity=CAPACITY)
    closes = assert_in_order(out)
    assert closes.any() and not closes.all()
    n = int(out.num_points)
    ends = np.asarray(out.following)[:n] == CAPACITY
    place = (np.asarray(out.points)[:n][ends] - ORIGIN) / SPACING
    at_side = (np.abs(place) < 1e-6) | (np.abs(place - np.array(SHAPE) + 1) < 1e-6)
    assert at_side.any(axis=1).all()


def test_a_circle_has_its_area_to_second_order(x64):
    errors = []
    for n in (20, 40, 80):
        x, y = np.meshgrid(
            np.linspace(-1, 1.1, n), np.linspace(-1.2, 1, n), indexing="ij"
        )
        out = run(
            np.exp(x * x + y * y) - np.exp(0.5),
            np.array([-1, -1.2]),
            np.array([2.1, 2.2]) / (n - 1),
            capacity=CAPACITY,
        )
        assert int(out.num_lines) == 1 and assert_in_order(out).all()
        errors.append(abs(area(out) - np.pi / 2))
    assert errors[2] < errors[1] / 2**1.6 < errors[0] / 2**3.2


def test_derivatives_are_central_differences(x64):
    weights = noise(1, (CAPACITY, 2))

    @jax.jit
    def scalar(values, origin, spacing, level):
        out = marching_squares(values, origin, spacing, level, capacity=CAPACITY)
        return jnp.sum(weights * out.points)

    at = (noise(2), ORIGIN, SPACING, np.float64(0.05))
    slopes = jax.jit(jax.grad(scalar, argnums=(0, 1, 2, 3)))(*at)
    for i, point in enumerate(at):
        along = noise(3 + i, np.shape(point))
        moved = lambda h, i=i, a=along: scalar(*at[:i], at[i] + h * a, *at[i + 1 :])
        expected = (moved(1e-7) - moved(-1e-7)) / 2e-7
        np.testing.assert_allclose(np.sum(slopes[i] * along), expected, rtol=2e-5)


def test_vmap_statuses_and_errors(x64):
    bad = noise(5)
    bad[3, 4] = np.nan
    batch = np.stack([noise(4), bad, np.ones(SHAPE)])
    one = functools.partial(
        marching_squares, origin=ORIGIN, spacing=SPACING, capacity=CAPACITY
    )
    many = jax.jit(jax.vmap(one))(batch)
    for i, status in enumerate(
        (RESULTS.successful, RESULTS.nonfinite_input, RESULTS.no_surface)
    ):
        single = run(batch[i], ORIGIN, SPACING, capacity=CAPACITY)
        got = jax.tree.map(lambda x, i=i: x[i], many)
        assert bool(got.result == status) and bool(single.result == status)
        np.testing.assert_allclose(got.points, single.points, atol=1e-12)
        np.testing.assert_array_equal(got.following, single.following)
        assert np.isfinite(got.points).all()
    short = run(noise(4), ORIGIN, SPACING, capacity=50)
    assert bool(short.result == RESULTS.capacity_exceeded)
    assert int(short.required_points) == int(many.required_points[0])
    with pytest.raises(GeometryError, match="at least 2 nodes"):
        marching_squares(np.ones((1, 5)), ORIGIN, SPACING, capacity=9)
