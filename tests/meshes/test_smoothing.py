"""Smoothing: what it keeps, what it takes away, gradients, statuses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS
from jaxgeom.meshes import (
    Implicit,
    Laplacian,
    Taubin,
    boundary_vertices,
    cotangent_laplacian,
    icosphere,
    lumped_mass,
    smooth,
    volume,
)
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import (
    closed_meshes,
    cut,
    flat_patch,
    sized,
    slope_and_difference,
    stacked,
)

V, F = 170, 330
METHODS = {
    "laplacian": Laplacian(steps=5),
    "cotangent": Laplacian(steps=3, rate=0.4, laplacian=cotangent_laplacian),
    "taubin": Taubin(steps=5),
    "implicit": Implicit(0.05, rtol=1e-12),
}


def all_methods(mesh, fixed):
    return {name: smooth(mesh, m, fixed=fixed) for name, m in METHODS.items()}


RUN = jax.jit(all_methods)
FREE = np.zeros(V, bool)


def noisy_sphere():
    ball = icosphere(2, radius=1.4)
    noise = np.random.default_rng(0).normal(size=(162, 3))
    return TriangleMesh(np.asarray(ball.vertices) + 0.04 * noise, ball.faces)


def run(mesh, fixed=FREE):
    return RUN(sized(mesh, V, F), fixed)


def roughness(points):
    return np.std(np.linalg.norm(np.asarray(points)[:162], axis=1))


def test_noise_goes(x64):
    mesh = noisy_sphere()
    found = run(mesh)
    before, whole = roughness(mesh.vertices), 4 / 3 * np.pi * 1.4**3
    for name, share in (("laplacian", 0.35), ("taubin", 0.6), ("implicit", 0.6)):
        assert found[name].result == RESULTS.successful
        assert roughness(found[name].mesh.vertices) < share * before
        assert np.all(found[name].mesh.vertices[162:] == 0)
    shrunk = {n: float(volume(found[n].mesh)) / whole for n in ("laplacian", "taubin")}
    assert shrunk["laplacian"] < 0.9 < 0.96 < shrunk["taubin"] < 1.04


def test_implicit_smoothing_keeps_the_center_of_mass(x64):
    mesh = cut(closed_meshes()["torus"])
    moved = run(mesh)["implicit"].mesh.vertices
    like = sized(mesh, V, F)
    mass = np.asarray(jax.jit(lumped_mass)(like))[: mesh.vertices.shape[0], None]
    there = np.asarray(moved)[: len(mass)]
    assert np.abs(there - mesh.vertices).max() > 0.05
    np.testing.assert_allclose(np.sum(mass * (there - mesh.vertices), 0), 0, atol=1e-10)


def test_implicit_smoothing_solves_its_equation(x64):
    mesh = cut(closed_meshes()["torus"])
    like = sized(mesh, V, F)
    fixed = np.asarray(jax.jit(boundary_vertices)(like))
    found = run(mesh, fixed)["implicit"]
    assert found.residual < 1e-12 and found.steps > 5
    matrix = jax.jit(cotangent_laplacian)(like).to_scipy()
    mass = np.asarray(jax.jit(lumped_mass)(like))[:, None]
    x, old = np.asarray(found.mesh.vertices), np.nan_to_num(np.asarray(like.vertices))
    gap = mass * (x - old) + 0.05 * (matrix @ x)
    np.testing.assert_allclose(gap[~fixed], 0, atol=1e-10)
    np.testing.assert_allclose(x[fixed], old[fixed], atol=1e-12)


def test_fixed_vertices_stay_and_planes_stay_planes(x64):
    mesh = flat_patch()
    fixed = np.asarray(jax.jit(boundary_vertices)(sized(mesh, V, F)))
    assert fixed.sum() == 22
    a, b, c = mesh.vertices[:3]
    normal = np.cross(b - a, c - a)
    for found in run(mesh, fixed).values():
        there = np.asarray(found.mesh.vertices)[:42]
        np.testing.assert_allclose(there[fixed[:42]], mesh.vertices[fixed[:42]])
        np.testing.assert_allclose((there - a) @ normal, 0, atol=1e-10)
    # A harmonic map of linear coordinates: the cotangent flow leaves a plane at rest.
    flow = np.asarray(run(mesh, fixed)["implicit"].mesh.vertices)[:42]
    np.testing.assert_allclose(flow, mesh.vertices, atol=1e-10)


def test_gradients_are_central_differences(x64):
    mesh = sized(cut(closed_meshes()["torus"]), V, F, garbage=1.7)
    counts = {"num_vertices": mesh.num_vertices, "num_faces": mesh.num_faces}
    fixed = np.arange(V) % 7 == 0
    probe = jnp.asarray(np.random.default_rng(2).normal(size=(3, V, 3)))

    def value(x, time, rate):
        m = TriangleMesh(x, mesh.faces, **counts)
        methods = (
            Taubin(steps=2, rate=rate),
            Laplacian(steps=2, rate=rate, laplacian=cotangent_laplacian),
            Implicit(time, rtol=1e-13),
        )
        moved = jnp.stack(
            [smooth(m, how, fixed=fixed).mesh.vertices for how in methods]
        )
        return jnp.sum(probe * moved)

    along = np.random.default_rng(3).normal(size=(V, 3))
    start, way = np.zeros(V * 3 + 2), np.concatenate([along.ravel(), [0.01, 0.2]])
    full = lambda z: value(
        mesh.vertices + z[:-2].reshape(V, 3), 0.05 + z[-2], 0.5 + z[-1]
    )
    slope, exact, numeric = slope_and_difference(full, start, way, step=1e-5)
    assert exact == pytest.approx(numeric, rel=1e-6)
    assert np.all(slope[3 * int(mesh.num_vertices) : -2] == 0)


@pytest.mark.slow
def test_a_batch_in_single_precision_is_each_in_double():
    meshes = [noisy_sphere(), cut(closed_meshes()["torus"])]
    small = [sized(m, V, F, dtype=np.float32) for m in meshes]
    method = Implicit(0.05)
    flow = lambda m: smooth(m, method)
    batch = jax.jit(jax.vmap(flow))(stacked(*small))
    assert batch.mesh.vertices.dtype == np.float32
    assert np.all(batch.residual <= 1e-5) and np.all(batch.result == RESULTS.successful)
    with jax.enable_x64(True):
        for i, mesh in enumerate(meshes):
            one = run(mesh)["implicit"].mesh.vertices
            np.testing.assert_allclose(batch.mesh.vertices[i], one, atol=2e-4)


def test_statuses_and_errors():
    mesh = sized(noisy_sphere(), V, F, dtype=np.float32)
    late = jax.jit(lambda m: smooth(m, Implicit(9.0, max_steps=2)))(mesh)
    assert late.result == RESULTS.not_converged and late.residual > 1e-5
    with pytest.raises(ValueError, match="fixed must have shape"):
        smooth(mesh, fixed=np.zeros(3, bool))
