"""Tessellation: convergence, seams, gradients, what it refuses; trimmed surfaces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import GeometryError
from jaxgeom import parametric as jp
from jaxgeom.meshes import volume

from .members import counted, net

PATCH = jp.Patch((0.1, 0.2, 0.0), (2.0, 0, 0), (0, 1.5, 0))


def ring(center, radius, number):
    angle = np.linspace(0, 2 * np.pi, number, endpoint=False)
    return np.asarray(center) + radius * np.stack([np.cos(angle), np.sin(angle)], 1)


def star(points, inner=0.12, outer=0.45):
    angle = np.arange(2 * points) * np.pi / points
    reach = np.where(np.arange(2 * points) % 2, inner, outer)[:, None]
    return 0.5 + reach * np.stack([np.cos(angle), np.sin(angle)], 1)


SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
NEEDLE = np.array([[0.1, 0.1], [0.9, 0.12], [0.1, 0.14]])
SHAPES = {
    "circle": [ring((0.5, 0.5), 0.3, 40)],
    "plate with holes": [SQUARE, ring((0.3, 0.3), 0.15, 20), ring((0.7, 0.6), 0.2, 9)],
    "star": [star(7)],
    "needle": [NEEDLE],
    "narrow gap": [SQUARE, ring((0.5, 0.5), 0.4995, 64)],
    "finer than the cells": [ring((0.5, 0.5), 0.45, 300)],
    "island in a hole": [SQUARE, star(5), ring((0.5, 0.5), 0.05, 6)],
}


def signed_area(loop):
    x, y = np.asarray(loop).T
    return np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) / 2


@pytest.mark.parametrize(
    "surface, exact",
    [
        (jp.Torus(1.3, 0.4), 2 * np.pi**2 * 1.3 * 0.16),
        (jp.Ellipsoid((0.7, 0.4, 0.5)), 4 / 3 * np.pi * 0.14),
    ],
)
def test_volumes_converge_at_second_order(surface, exact, x64):
    size = jax.jit(lambda s, cells: volume(jp.tessellate(s, cells)), static_argnums=1)
    errors = [abs(float(size(surface, (12 * k, 8 * k))) / exact - 1) for k in (1, 2, 4)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 2, atol=0.1)


def test_gradients_of_a_volume(x64):
    """d V / d radius of the mesh, against central differences."""
    size = lambda r: volume(jp.tessellate(jp.Torus(r[0], r[1]), (12, 8)))
    at, h = jnp.array([1.3, 0.4]), 1e-6
    steps = h * jnp.eye(2)

    @jax.jit
    def both(r):
        differences = [(size(r + d) - size(r - d)) / (2 * h) for d in steps]
        return jax.grad(size)(r), jnp.stack(differences)

    slope, differences = both(at)
    np.testing.assert_allclose(slope, differences, rtol=1e-8)


def test_batches_of_tessellations():
    radii = jnp.array([0.3, 0.4])
    make = lambda r: jp.tessellate(jp.Torus(1.3, r), (12, 8))
    many, one = jax.jit(lambda r: (jax.vmap(make)(r), make(r[1])))(radii)
    np.testing.assert_allclose(many.vertices[1], one.vertices, atol=1e-6)


def test_seams_poles_and_their_parameters():
    sphere = jp.Sphere(0.7)
    plan = jp.layout(sphere.domain(), (6, 4))
    mesh = jax.jit(lambda s: jp.tessellate(s, (6, 4)))(sphere)
    assert mesh.vertices.shape[0] == 6 * 3 + 2 and mesh.faces.shape[0] == 6 * 6
    np.testing.assert_allclose(mesh.attributes["uv"], plan.uv, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, plan.faces)
    # Corners have the place of their vertex and the parameters of their own side.
    corners = jax.jit(jax.vmap(jax.vmap(sphere)))(jnp.asarray(plan.corner_uv))
    np.testing.assert_allclose(corners, mesh.vertices[mesh.faces], atol=1e-6)
    assert plan.uv[:, 0].max() < 2 * np.pi - 1
    assert plan.corner_uv[..., 0].max() == 2 * np.pi
    wide = np.ptp(plan.corner_uv[..., 0], axis=1)
    np.testing.assert_allclose(wide, 2 * np.pi / 6)


def test_cells_end_at_knots():
    surface = net()
    u = np.unique(jp.layout(surface.domain(), (4, 3)).uv[:, 0])
    for knot in surface.bases[0].breaks:
        assert np.isclose(u, knot).any()


LONG = {"circle", "needle", "finer than the cells", "star"}
CASES = [pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in SHAPES]


@pytest.mark.parametrize("name", CASES)
def test_trimmed_surfaces_are_exact(name, x64):
    loops = SHAPES[name]
    mesh = jp.tessellate_trimmed(PATCH, loops, (16, 12))
    faces, uv = np.asarray(mesh.faces), np.asarray(mesh.attributes["uv"])
    count = counted(faces)
    assert count.manifold and count.oriented and not count.closed
    assert count.boundary_loops == len(loops)
    a, b, c = (uv[faces[:, i]] for i in range(3))
    (p, q), (r, s) = (b - a).T, (c - a).T
    areas = (p * s - q * r) / 2
    assert (areas > 0).all()
    # The outline counts, the holes are missing, what lies in a hole counts again.
    signs = (1, -1, 1) if name.startswith("island") else (1, -1, -1)
    expected = sum(s * abs(signed_area(p)) for s, p in zip(signs, loops, strict=False))
    np.testing.assert_allclose(areas.sum(), expected, rtol=1e-12)
    for corner in np.concatenate(loops):
        assert np.min(np.linalg.norm(uv - corner, axis=1)) < 1e-12
    border_is_on_the_loops(faces, uv, loops)


def border_is_on_the_loops(faces, uv, loops):
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2)
    _, index, times = np.unique(
        np.sort(directed, axis=1), axis=0, return_index=True, return_counts=True
    )
    middles = uv[directed[index[times == 1]]].mean(axis=1)
    start = np.concatenate(loops)
    along = np.concatenate([np.roll(p, -1, axis=0) for p in loops]) - start
    share = np.sum((middles[:, None] - start) * along, -1) / np.sum(along**2, -1)
    gap = middles[:, None] - start - np.clip(share, 0, 1)[..., None] * along
    assert np.linalg.norm(gap, axis=-1).min(axis=1).max() < 1e-12


def test_a_trimmed_patch_of_a_torus_follows_it(x64):
    hole = np.array([3.0, 2.5]) + 0.8 * (star(5) - 0.5)
    outline = np.array([[1.0, 1.0], [5.0, 1.2], [4.8, 4.5], [1.2, 4.0]])
    torus = jp.Torus(1.3, 0.4)

    def size(minor):
        mesh = jp.tessellate_trimmed(jp.Torus(1.3, minor), [outline, hole], (24, 24))
        return mesh.vertices.sum(), mesh

    (_, mesh), slope = jax.value_and_grad(size, has_aux=True)(jnp.asarray(0.4))
    at = jax.jit(jax.vmap(torus))(mesh.attributes["uv"])
    np.testing.assert_allclose(mesh.vertices, at, atol=1e-14)
    unit = (at - jax.jit(jax.vmap(jp.Torus(1.3, 1e-9)))(mesh.attributes["uv"])) / 0.4
    np.testing.assert_allclose(slope, unit.sum(), rtol=1e-6)


def test_inside_loops_counts_crossings():
    loops = SHAPES["island in a hole"]
    points = [(0.5, 0.5), (0.5, 0.6), (0.05, 0.95), (1.2, 0.5)]
    np.testing.assert_array_equal(jp.inside_loops(points, loops), [1, 0, 1, 0])


BOW = np.array([[0.1, 0.1], [0.9, 0.9], [0.9, 0.1], [0.1, 0.9]])


@pytest.mark.parametrize(
    "loops, words",
    [
        ([], "at least one loop"),
        ([np.zeros((2, 2))], "shape"),
        ([SQUARE * 1.2], "lie within"),
        ([SQUARE[[0, 0, 1, 2]]], "corners must differ"),
        ([BOW], "cross or touch"),
        ([SQUARE, ring((0.5, 0.5), 0.5, 40)], "cross or touch"),
        ([np.array([[0, 0], [0.5, 0.5], [0.2, 0.2], [0, 0.5]])], "cross or touch"),
    ],
)
def test_bad_loops_are_refused(loops, words):
    with pytest.raises(GeometryError, match=words):
        jp.tessellate_trimmed(PATCH, loops)


@pytest.mark.parametrize(
    "surface, size",
    [(jp.Sphere(0.7), (2, 5)), (jp.Sphere(0.7), (5, 1)), (PATCH, (0, 1))],
)
def test_too_few_cells_are_refused(surface, size):
    with pytest.raises(GeometryError, match="resolution"):
        jp.tessellate(surface, size)
