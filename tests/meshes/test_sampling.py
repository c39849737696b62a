"""Samples are on the surface, uniform, differentiable, blind to padding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom.meshes import (
    box_mesh,
    face_areas,
    face_normals,
    icosphere,
    interpolate,
    sample_surface,
)
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import central_difference, closed_meshes, padded, stacked


def test_samples_are_where_they_say(x64):
    mesh = closed_meshes()["torus"]
    s = sample_surface(mesh, 500, key=jax.random.key(1))
    np.testing.assert_allclose(jnp.sum(s.barycentric, axis=1), 1, atol=1e-12)
    assert jnp.all(s.barycentric >= 0) and jnp.all(s.mask)
    there = interpolate(mesh, mesh.vertices, s.faces, s.barycentric)
    np.testing.assert_allclose(s.points, there, atol=1e-12)
    np.testing.assert_allclose(s.normals, face_normals(mesh)[s.faces], atol=1e-12)
    assert s.cloud().num_points == 500


def test_samples_are_uniform_by_area():
    mesh = box_mesh((0.2, 2.1, 1.3))
    n = 40_000
    s = jax.jit(lambda m, k: sample_surface(m, n, key=k))(mesh, jax.random.key(7))
    share = np.asarray(face_areas(mesh) / jnp.sum(face_areas(mesh)))
    seen = np.bincount(s.faces, minlength=12)
    chi_square = np.sum((seen - n * share) ** 2 / (n * share))
    assert chi_square < 31.3  # the 0.1 % point for 11 degrees of freedom
    # Uniform in a triangle: every coordinate has mean 1/3 and variance 1/18.
    np.testing.assert_allclose(jnp.mean(s.barycentric, axis=0), 1 / 3, atol=6e-3)
    np.testing.assert_allclose(jnp.var(s.barycentric, axis=0), 1 / 18, atol=2e-3)


def test_faces_without_area_are_never_drawn():
    mesh = icosphere(0)
    empty = jnp.array([[0, 0, 1], [3, 3, 3]], jnp.int32)
    faces = jnp.concatenate([empty, mesh.faces[:3], empty, mesh.faces[3:], empty])
    s = sample_surface(TriangleMesh(mesh.vertices, faces), 3000, key=jax.random.key(0))
    assert set(np.unique(s.faces)) == set(range(2, 5)) | set(range(7, 24))


def test_gradients_are_central_differences(x64):
    mesh = closed_meshes()["sphere"]
    probe = jax.random.normal(jax.random.key(4), (2, 30, 3))

    # A translation and rotation keep the areas, so that no face choice changes.
    def probed(angle):
        c, s = jnp.cos(angle), jnp.sin(angle)
        turn = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        moved = TriangleMesh(mesh.vertices @ turn.T + angle, mesh.faces)
        drawn = sample_surface(moved, 30, key=jax.random.key(2))
        return jnp.sum(probe[0] * drawn.points) + jnp.sum(probe[1] * drawn.normals)

    numeric = central_difference(probed, jnp.asarray(0.3), jnp.asarray(1.0))
    assert jax.grad(probed)(0.3) == pytest.approx(float(numeric), rel=1e-7)


def test_padding_changes_nothing():
    mesh = closed_meshes()["box"]
    more = padded(mesh)
    one = sample_surface(mesh, 200, key=jax.random.key(3))
    two = sample_surface(more, 200, key=jax.random.key(3))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
        np.testing.assert_array_equal(a, b)
    counts = {"num_vertices": more.num_vertices, "num_faces": more.num_faces}
    total = lambda x: jnp.sum(
        sample_surface(
            TriangleMesh(x, more.faces, **counts), 200, key=jax.random.key(3)
        ).points
        ** 2
    )
    gradient = jax.grad(total)(more.vertices)
    assert jnp.all(gradient[mesh.vertices.shape[0] :] == 0)
    assert jnp.all(jnp.isfinite(gradient))


@pytest.mark.slow
def test_vmap_is_loop():
    meshes = (
        icosphere(1),
        TriangleMesh(1.7 * icosphere(1).vertices, icosphere(1).faces),
    )
    keys = jax.random.split(jax.random.key(0), 2)
    draw = lambda m, k: sample_surface(m, 50, key=k)
    batched = jax.vmap(draw)(stacked(*meshes), keys)
    for i, mesh in enumerate(meshes):
        np.testing.assert_allclose(
            batched.points[i], draw(mesh, keys[i]).points, atol=1e-6
        )


def test_no_surface_no_samples():
    empty = TriangleMesh(jnp.zeros((4, 3)), jnp.zeros((0, 3), jnp.int32))
    flat = TriangleMesh(jnp.ones((4, 3)), jnp.array([[0, 1, 2]]))
    for mesh in (empty, flat):
        s = sample_surface(mesh, 5, key=jax.random.key(0))
        assert not jnp.any(s.mask)
        assert jnp.all(s.points == 0) and jnp.all(s.faces == mesh.faces.shape[0])
    with pytest.raises(ValueError, match="must not be negative"):
        sample_surface(flat, -1, key=jax.random.key(0))
