"""Marching cubes on bricks is marching cubes on the dense grid."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.fields import NarrowBand, Sphere, declare, gyroid, narrow_band
from jaxgeom.isosurface import (
    AsymptoticDecider,
    Capacity,
    MarchingCubes,
    TrilinearDecider,
    extract,
    marching_cubes_on_bricks,
)
from jaxgeom.shapes import Grid

SHAPE = (41, 33, 50)
GRID = Grid(np.float32([0.3, -1.2, 2.0]), np.float32([0.5, 0.8, 0.3]), SHAPE)
BALL = Sphere(0.71, (0.1, -0.05, 0.02))
BOX = Grid(np.float32([-0.8, -0.9, -1.0]), np.float32([0.043, 0.05, 0.04]), SHAPE)


def lattice(values):
    """The field of these values at the nodes of GRID; no use between them."""

    def field(point):
        index = jnp.round((point - GRID.origin) / GRID.spacing).astype(int)
        x, y, z = jnp.clip(index, 0, np.array(SHAPE) - 1)
        return jnp.asarray(values)[x, y, z]

    return field


def canonical(mesh, grid):
    """Vertices in the order of their edges, and faces as a sorted list of them."""
    places = (np.asarray(mesh.vertices, np.float64) - grid.origin) / grid.spacing
    axis = np.argmax(np.abs(places - np.round(places)), axis=1)
    rows = np.arange(len(places))
    node = np.round(places).astype(int)
    node[rows, axis] = np.floor(places[rows, axis])
    order = np.lexsort([axis, *node.T])
    number = np.empty_like(order)
    number[order] = rows
    faces = number[np.asarray(mesh.faces)]
    turn = (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3
    faces = np.take_along_axis(faces, turn, axis=1)
    return places[order], faces[np.lexsort(faces.T)]


def assert_same(mesh, other, grid):
    (places, faces), (expected, wanted) = (canonical(m, grid) for m in (mesh, other))
    np.testing.assert_array_equal(faces, wanted)
    np.testing.assert_allclose(places, expected, atol=1e-3)


@pytest.mark.parametrize("kind", ["noise", "ties"])
@pytest.mark.parametrize(
    "ambiguity",
    [
        TrilinearDecider(),
        *(pytest.param(r, marks=pytest.mark.slow) for r in (None, AsymptoticDecider())),
    ],
)
def test_white_noise_and_ties_give_the_dense_mesh(kind, ambiguity):
    rng = np.random.default_rng(0)
    noise = (
        rng.standard_normal(SHAPE) if kind == "noise" else rng.integers(-1, 2, SHAPE)
    )
    noise = noise.astype(np.float32)
    method = MarchingCubes(normals=False)
    if ambiguity is not None:
        method = MarchingCubes(ambiguity=ambiguity, normals=False)
    out = extract(
        NarrowBand.around(lattice(noise), GRID, lipschitz=np.inf), method=method
    )
    assert_same(out.mesh, extract(noise, GRID, method=method).mesh, GRID)


def test_a_ball_is_the_dense_one_closed_and_needs_few_bricks(tools):
    band = NarrowBand.around(BALL, BOX)
    assert band.num_bricks < 0.6 * np.prod([-(-n // 8) for n in SHAPE])
    out = extract(band)
    assert out.result == RESULTS.successful
    tools.assert_closed(out.mesh)
    assert_same(out.mesh, extract(BALL, BOX).mesh, BOX)


@pytest.mark.parametrize("field", [BALL, gyroid(0.7)], ids=["ball", "gyroid"])
def test_at_64_cubed_the_mesh_is_the_dense_one_and_closed(field, tools):
    spacing = np.float32([0.021, 0.019, 0.017])
    grid = Grid(np.float32([-0.7, -0.8, -0.6]), spacing, (64, 64, 64))
    method = MarchingCubes(normals=False)
    out = extract(NarrowBand.around(field, grid, closed=True), method=method)
    assert out.result == RESULTS.successful
    tools.assert_closed(out.mesh)
    dense = extract(field, grid, method=method, closed=True)
    assert_same(out.mesh, dense.mesh, grid)


def test_the_compiled_form_reports_its_need():
    size = int(NarrowBand.around(BALL, BOX).num_bricks)
    run = lambda n: narrow_band(BALL, BOX, capacity=n)
    small = run(40)
    assert small.result == RESULTS.capacity_exceeded and small.required_bricks >= 40
    enough = run(int(small.required_bricks) * 2)
    assert enough.num_bricks >= size and enough.result == RESULTS.successful


def test_overflow_keeps_faces_that_name_existing_vertices():
    band = NarrowBand.around(BALL, BOX)
    run = jax.jit(lambda b: marching_cubes_on_bricks(b, capacity=Capacity(3000, 9000)))
    out = run(band)
    assert out.result == RESULTS.capacity_exceeded
    faces = np.asarray(out.mesh.faces)[: int(out.mesh.num_faces)]
    assert 0 < len(faces) and faces.max() < 3000


def test_a_steep_field_is_reported():
    right, wrong = (NarrowBand.around(BALL, BOX, lipschitz=x) for x in (1.0, 0.8))
    assert 0 < wrong.num_bricks < right.num_bricks
    assert extract(right).result == RESULTS.successful
    assert extract(wrong).result == RESULTS.steep_field


def test_no_surface_and_values_that_are_no_numbers_are_reported():
    far = NarrowBand.around(BALL, BOX, 5.0)
    assert far.result == RESULTS.no_surface and far.num_bricks == 0
    assert extract(far).result == RESULTS.no_surface
    band = NarrowBand.around(BALL, BOX)
    hole = dataclasses.replace(band, values=band.values.at[3, 4, 4, 4].set(jnp.nan))
    assert extract(hole).result == RESULTS.nonfinite_input


def test_the_derivative_reaches_the_vertices_under_jit():
    center, radius = np.array([0.1, -0.05, 0.02]), 0.71

    def vertices(radius):
        band = narrow_band(Sphere(radius, jnp.float32(center)), BOX, capacity=256)
        out = marching_cubes_on_bricks(
            band, capacity=Capacity(8000, 16000), normals=False
        )
        return out.mesh.vertices, (out.mesh.num_vertices, out.result)

    run = jax.jit(lambda r: jax.jvp(vertices, (r,), (1.0,), has_aux=True))
    points, speed, (count, result) = run(radius)
    assert result == RESULTS.successful and not np.any(speed[count:])
    points, speed = np.float64(points)[:count], np.float64(speed)[:count]
    places = (points - BOX.origin) / BOX.spacing
    rows, axis = np.arange(count), np.argmax(np.abs(places - np.round(places)), axis=1)
    low = np.round(places)
    low[rows, axis] = np.floor(places[rows, axis])
    high = low + np.eye(3)[axis]
    before, after = (
        np.linalg.norm(BOX.origin + BOX.spacing * x - center, axis=1) - radius
        for x in (low, high)
    )
    # t = f / (f - g) has the derivative 1 / (g - f); clamped vertices stay.
    t = before / (before - after)
    free = (t > 0.002) & (t < 0.998)
    wanted = np.eye(3)[axis] * (BOX.spacing[axis] / (after - before))[:, None]
    np.testing.assert_allclose(speed[free], wanted[free], rtol=0.01)
    assert free.mean() > 0.98


def test_a_field_that_does_not_tell_is_an_error():
    plain = lambda p: p[0]
    with pytest.raises(GeometryError, match="Lipschitz"):
        NarrowBand.around(plain, BOX)
    with pytest.raises(GeometryError, match="Lipschitz"):
        NarrowBand.around(declare(plain, lipschitz=np.inf), BOX)
    with pytest.raises(GeometryError, match="Lipschitz"):
        narrow_band(plain, BOX, capacity=8)
    with pytest.raises(GeometryError, match="capacity"):
        narrow_band(BALL, BOX, capacity=0)
    huge = Grid(BOX.origin, BOX.spacing, (8193, 5, 5))
    with pytest.raises(GeometryError, match="8192"):
        NarrowBand.around(BALL, huge)
    with pytest.raises(GeometryError, match="own grid"):
        extract(NarrowBand.around(BALL, BOX), BOX)
