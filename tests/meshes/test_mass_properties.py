"""Volume, center and inertia against trimesh and the ellipsoid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom.meshes import area, icosphere, solid_properties, surface_properties, volume
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import (
    closed_meshes,
    cut,
    peer,
    sized,
    slope_and_difference,
    stacked,
)

V, F = 170, 330


def both(mesh):
    return solid_properties(mesh), surface_properties(mesh)


RUN = jax.jit(both)


@pytest.mark.parametrize("name", ["box", "torus"])
def test_agrees_with_trimesh(x64, name):
    mesh = closed_meshes()[name]
    solid, surface = RUN(sized(mesh, V, F))
    other = peer(mesh)
    assert solid.mass == pytest.approx(other.volume, rel=1e-12)
    np.testing.assert_allclose(solid.centroid, other.center_mass, atol=1e-11)
    np.testing.assert_allclose(solid.inertia, other.moment_inertia, rtol=1e-9)
    assert solid.mass == pytest.approx(float(volume(mesh)), rel=1e-12)
    assert surface.mass == pytest.approx(float(area(mesh)), rel=1e-12)
    np.testing.assert_allclose(surface.centroid, other.centroid, atol=1e-11)


def test_the_inertia_of_a_surface_is_that_of_many_points(x64):
    mesh = cut(closed_meshes()["torus"])
    surface = RUN(sized(mesh, V, F))[1]
    a, b, c = np.moveaxis(np.asarray(mesh.vertices)[mesh.faces], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    # The middles of the sides integrate quadratic functions exactly.
    points = np.concatenate([(a + b) / 2, (b + c) / 2, (c + a) / 2]) - surface.centroid
    weights = np.tile(areas / 3, 3)
    second = np.einsum("n,ni,nj->ij", weights, points, points)
    expected = np.trace(second) * np.eye(3) - second
    np.testing.assert_allclose(surface.inertia, expected, rtol=1e-10, atol=1e-12)


def test_an_ellipsoid_converges_at_second_order(x64):
    a, b, c = half = np.array([1.3, 0.9, 0.6])
    mass = 4 / 3 * np.pi * a * b * c
    inertia = mass / 5 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
    errors = []
    for n in (1, 2):
        ball = icosphere(n)
        mesh = TriangleMesh(
            ball.vertices * half + np.array([2.0, -1.0, 0.5]), ball.faces
        )
        solid = RUN(sized(mesh, V, F))[0]
        np.testing.assert_allclose(solid.centroid, [2.0, -1.0, 0.5], atol=1e-12)
        errors.append(np.abs(solid.inertia - inertia).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.15)


def test_gradients_are_central_differences(x64):
    mesh = sized(closed_meshes()["torus"], V, F, garbage=2.5)
    counts = {"num_vertices": mesh.num_vertices, "num_faces": mesh.num_faces}
    probe = np.random.default_rng(0).normal(size=(2, 13))

    def value(x):
        solid, surface = both(TriangleMesh(x, mesh.faces, **counts))
        flat = [
            jnp.concatenate([p.mass[None], p.centroid, p.inertia.reshape(-1)])
            for p in (solid, surface)
        ]
        return jnp.sum(probe * jnp.stack(flat))

    way = np.random.default_rng(1).normal(size=(V, 3))
    slope, exact, numeric = slope_and_difference(value, mesh.vertices, way)
    assert exact == pytest.approx(numeric, rel=1e-6)
    assert np.all(slope[int(mesh.num_vertices) :] == 0)


def test_a_batch_in_single_precision_is_each_in_double():
    meshes = [closed_meshes()["torus"], closed_meshes()["box"]]
    small = [sized(m, V, F, dtype=np.float32) for m in meshes]
    batch = jax.jit(jax.vmap(both))(stacked(*small))
    with jax.enable_x64(True):
        for i, mesh in enumerate(meshes):
            pairs = zip(batch, RUN(sized(mesh, V, F)), strict=True)
            for several, one in pairs:
                assert several.inertia.dtype == np.float32
                for x, y in zip(*map(jax.tree.leaves, (several, one)), strict=True):
                    np.testing.assert_allclose(x[i], y, rtol=1e-4, atol=1e-4)
