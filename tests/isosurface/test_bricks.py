"""Marching cubes on bricks is marching cubes on the dense grid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS, GeometryError
from jaxgeom.fields import NarrowBand, Sphere, narrow_band
from jaxgeom.isosurface import (
    AsymptoticDecider,
    Capacity,
    MarchingCubes,
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
    "ambiguity", [pytest.param(None, marks=pytest.mark.slow), AsymptoticDecider()]
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
    wrong = NarrowBand.around(lambda p: 3.0 * BALL(p), BOX, lipschitz=0.2)
    assert extract(wrong).result != RESULTS.successful


def test_a_field_that_does_not_tell_is_an_error():
    with pytest.raises(GeometryError, match="Lipschitz"):
        NarrowBand.around(lambda p: p[0], BOX)
    with pytest.raises(GeometryError, match="own grid"):
        extract(NarrowBand.around(BALL, BOX), BOX)
