"""Laplacians, masses and curvatures: laws, orders of convergence, gradients.

All meshes lie in arrays of one size, so that every test is one of padding too.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom.meshes import (
    MixedVoronoiAreas,
    angle_defects,
    area,
    boundary_vertices,
    cotangent_laplacian,
    gaussian_curvature,
    icosphere,
    lumped_mass,
    mean_curvature,
    mean_curvature_vectors,
    principal_curvatures,
    report,
    torus_mesh,
    uniform_laplacian,
)
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import (
    bent,
    closed_meshes,
    cut,
    flat_patch,
    joined,
    moved,
    sized,
    stacked,
    with_faces,
)


def everything(mesh):
    """All that is tested here, by name."""
    principal = principal_curvatures(mesh)
    points = jnp.where(mesh.vertex_mask[:, None], mesh.vertices, 0)
    return {
        "H": mean_curvature(mesh),
        "Hn": mean_curvature_vectors(mesh),
        "K": gaussian_curvature(mesh),
        "defects": angle_defects(mesh),
        "k": principal.values,
        "directions": principal.directions,
        "normals": principal.normals,
        "mass": lumped_mass(mesh),
        "voronoi": lumped_mass(mesh, areas=MixedVoronoiAreas()),
        "boundary": boundary_vertices(mesh),
        "area": area(mesh),
        "cotangent": cotangent_laplacian(mesh),
        "uniform": uniform_laplacian(mesh),
        "Lx": cotangent_laplacian(mesh) @ points,
    }


RUN = jax.jit(everything)


def run(mesh):
    out = jax.tree.map(np.asarray, RUN(sized(mesh)))
    return out


@pytest.mark.parametrize("name", ["cotangent", "uniform"])
def test_laplacians_are_symmetric_and_positive(x64, name):
    mesh = cut(closed_meshes()["torus"])
    v = mesh.vertices.shape[0]
    operator = run(mesh)[name]
    matrix = operator.to_scipy().toarray()
    assert np.all(matrix[v:] == 0)
    matrix = matrix[:v, :v]
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-13)
    np.testing.assert_allclose(matrix.sum(axis=1), 0, atol=1e-12)
    values = np.linalg.eigvalsh(matrix)
    assert values[0] > -1e-12 and values[0] < 1e-12 < 1e-6 < values[1]
    np.testing.assert_allclose(operator.diagonal()[:v], np.diag(matrix), atol=1e-13)
    np.testing.assert_allclose(operator.dense()[:v, :v], matrix, atol=1e-13)
    np.testing.assert_array_equal(operator.T.dense(), operator.dense().T)
    x = np.random.default_rng(0).normal(size=(900, 2, 3))
    expected = np.einsum("ij,jkl->ikl", matrix, x[:v])
    np.testing.assert_allclose((operator @ x)[:v], expected, atol=1e-12)
    with pytest.raises(ValueError, match="the vector must have shape"):
        operator @ np.ones(5)


def test_a_plane_is_flat_and_its_linear_functions_harmonic(x64):
    mesh = flat_patch()
    found = run(mesh)
    inside = ~found["boundary"] & (np.arange(900) < 42)
    assert inside.sum() == 20
    np.testing.assert_allclose(found["Lx"][inside], 0, atol=1e-12)
    assert np.max(np.abs(found["Lx"][found["boundary"]])) > 0.1
    for name in ("H", "K", "k"):
        np.testing.assert_allclose(found[name], 0, atol=1e-12)


def test_energy_is_the_integral_of_the_squared_gradient(x64):
    mesh = flat_patch()
    found = run(mesh)
    slope = np.array([0.3, -1.2, 0.8])
    a, b, c = mesh.vertices[mesh.faces[0]]
    normal = np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
    along = slope - normal * (normal @ slope)
    energy = (mesh.vertices @ slope) @ (found["Lx"][:42] @ slope)
    assert energy == pytest.approx(found["area"] * along @ along, rel=1e-12)


def test_uniform_laplacian_counts_neighbors(x64):
    mesh = closed_meshes()["sphere"]
    matrix = run(mesh)["uniform"].to_scipy().toarray()
    valence = np.bincount(np.asarray(mesh.faces).ravel())
    np.testing.assert_array_equal(np.diag(matrix)[: len(valence)], valence)
    assert np.all(np.isin(matrix, [-1, 0, 5, 6]))


def test_masses_sum_to_the_area(x64):
    for mesh in (closed_meshes()["torus"], flat_patch(), bent(icosphere(1))):
        found, v = run(mesh), mesh.vertices.shape[0]
        for name in ("mass", "voronoi"):
            assert found[name].sum() == pytest.approx(found["area"], rel=1e-12)
            assert np.all(found[name][:v] > 0) and np.all(found[name][v:] == 0)


def test_voronoi_areas_of_a_right_and_an_obtuse_triangle(x64):
    corners = np.array([[0.0, 0, 0], [2, 0, 0], [0, 1, 0], [5, 0.5, 0]])
    at = lambda faces: run(TriangleMesh(corners, np.array([faces])))["voronoi"][:4]
    np.testing.assert_allclose(at([0, 1, 2]), [0.5, 0.25, 0.25, 0], atol=1e-15)
    whole = np.linalg.norm(np.cross(corners[1], corners[3])) / 2
    np.testing.assert_allclose(at([0, 1, 3]) / whole, [0.25, 0.5, 0, 0.25], atol=1e-15)


def test_gauss_and_bonnet(x64):
    torus = closed_meshes()["torus"]
    both = joined(closed_meshes()["sphere"], moved(torus, (9.0, 0, 0)))
    crowded = np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]])
    fan = TriangleMesh(np.random.default_rng(1).normal(size=(5, 3)), crowded)
    # With bow-ties, and with three faces on an edge.
    for mesh in (closed_meshes()["box"], torus, both, cut(torus), flat_patch(), fan):
        found = run(mesh)
        expected = 2 * np.pi * report(mesh).euler
        assert found["defects"].sum() == pytest.approx(expected, abs=1e-10)


def errors(mesh, k1, k2):
    """Root mean square errors of H, K and both principal curvatures."""
    v = mesh.vertices.shape[0]
    found = {name: x[:v] for name, x in run(mesh).items() if np.ndim(x)}
    mass = found["mass"] / found["mass"].sum()
    rms = lambda x, y: np.sqrt(np.sum(mass * (x - y) ** 2))
    pairs = [(found["H"], (k1 + k2) / 2), (found["K"], k1 * k2)]
    return np.array(
        [rms(*p) for p in [*pairs, *zip(found["k"].T, (k1, k2), strict=True)]]
    )


def test_a_sphere_has_one_curvature(x64):
    k = 1 / 1.3
    away = (0.3, -2.0, 1.0)
    coarse, fine = (errors(moved(icosphere(n, radius=1.3), away), k, k) for n in (1, 2))
    # The normals and the fit are exact for vertices on a sphere.
    assert np.all(fine[2:] < 1e-12)
    assert fine[0] < 1e-4
    assert np.log2(coarse[1] / fine[1]) == pytest.approx(2, abs=0.1)


def test_torus_curvatures_converge_at_second_order(x64):
    found = []
    for n in (1, 2):
        mesh = torus_mesh(1.6, 0.45, around=24 * n, across=9 * n)
        reach = np.hypot(mesh.vertices[:, 0], mesh.vertices[:, 1])
        k2 = (reach - 1.6) / 0.45 / reach
        found.append(errors(mesh, np.full_like(k2, 1 / 0.45), k2))
    np.testing.assert_allclose(np.log2(found[0] / found[1]), 2, atol=0.2)


def test_principal_directions_of_a_torus(x64):
    mesh = torus_mesh(1.6, 0.45, around=24, across=9)
    found = run(mesh)
    directions, normals = found["directions"][:216], found["normals"][:216]
    x, y, _ = np.asarray(mesh.vertices).T
    around = np.stack([-y, x, 0 * x], -1) / np.hypot(x, y)[:, None]
    # The tube bends most across itself: the second direction runs around the axis.
    assert np.min(np.abs(np.sum(directions[:, 1] * around, -1))) > 0.99
    gram = np.einsum("vid,vjd->vij", directions, directions)
    np.testing.assert_allclose(gram - np.eye(2), 0, atol=1e-12)
    across = np.einsum("vid,vd->vi", directions, normals)
    np.testing.assert_allclose(across, 0, atol=1e-12)


def test_curvature_follows_scale_and_side(x64):
    mesh = closed_meshes()["torus"]
    plain = run(mesh)
    double = run(TriangleMesh(2.5 * mesh.vertices, mesh.faces))
    inside = run(with_faces(mesh, mesh.faces[:, ::-1]))
    for name, power in (("H", 1), ("K", 2), ("k", 1), ("Hn", 1)):
        np.testing.assert_allclose(double[name] * 2.5**power, plain[name], atol=1e-11)
    np.testing.assert_allclose(inside["H"], -plain["H"], atol=1e-11)
    np.testing.assert_allclose(inside["Hn"], plain["Hn"], atol=1e-11)
    np.testing.assert_allclose(inside["K"], plain["K"], atol=1e-11)
    np.testing.assert_allclose(inside["k"], -plain["k"][:, ::-1], atol=1e-11)
    ball = icosphere(2)
    outward = np.sum(run(ball)["Hn"][:162] * np.asarray(ball.vertices), -1)
    np.testing.assert_allclose(outward, 1, rtol=1e-3)


def like(x, mesh):
    """The mesh with other vertices."""
    counts = {"num_vertices": mesh.num_vertices, "num_faces": mesh.num_faces}
    return TriangleMesh(x, mesh.faces, **counts)


def probed(x, mesh, probe):
    """One number from the curvatures that the Laplacian and the angles give."""
    mesh = like(x, mesh)
    washed = jnp.where(mesh.vertex_mask[:, None], x, 0)
    parts = [
        mean_curvature(mesh),
        gaussian_curvature(mesh),
        lumped_mass(mesh, areas=MixedVoronoiAreas()),
        cotangent_laplacian(mesh) @ jnp.sin(washed[:, 0]),
    ]
    return jnp.sum(probe * jnp.stack(parts))


def probed_principal(x, mesh, probe):
    """One number from the principal curvatures and directions."""
    found = principal_curvatures(like(x, mesh))
    squares = jnp.sum(found.directions**2 * jnp.arange(3), axis=-1)
    return jnp.sum(probe * jnp.concatenate([found.values.T, squares.T]))


@pytest.mark.parametrize(
    "function", [probed, pytest.param(probed_principal, marks=pytest.mark.slow)]
)
def test_gradients_are_central_differences(x64, function):
    way = np.random.default_rng(5).normal(size=(130, 3))
    probe = np.random.default_rng(6).normal(size=(4, 130))
    run = jax.jit(jax.value_and_grad(function))
    mesh = sized(cut(closed_meshes()["torus"]), 130, 250, garbage=3.7)
    value = lambda sign: run(mesh.vertices + sign * 1e-6 * way, mesh, probe)[0]
    slope = np.asarray(run(mesh.vertices, mesh, probe)[1])
    numeric = (value(1) - value(-1)) / 2e-6
    assert np.vdot(slope, way) == pytest.approx(float(numeric), rel=1e-6)
    assert np.all(slope[int(mesh.num_vertices) :] == 0)
    # Faces without area: flat, folded, twice the same vertex.
    line = [[0.2, 0.1, 0], [1.3, 0, 0], [2.4, -0.1, 0], [0.2, 0.1, 0]]
    faces = np.array([[0, 1, 2], [0, 0, 1], [0, 3, 1], [1, 1, 1]])
    flat = sized(TriangleMesh(np.array(line), faces), 130, 250, garbage=1.0)
    assert np.all(np.isfinite(run(flat.vertices, flat, probe)[1]))


@pytest.mark.slow
def test_a_batch_in_single_precision_is_each_in_double():
    meshes = [closed_meshes()["torus"], bent(icosphere(2)), flat_patch()]
    small = [sized(m, dtype=np.float32) for m in meshes]
    batch = jax.jit(jax.vmap(everything))(stacked(*small))
    for name in ("H", "K", "k", "mass", "voronoi", "defects", "normals", "Lx"):
        assert batch[name].dtype == jnp.float32
    batch = jax.tree.map(np.asarray, batch)
    with jax.enable_x64(True):
        for i, mesh in enumerate(meshes):
            one = run(mesh)
            for name in ("H", "K", "k", "mass", "voronoi", "defects", "normals", "Lx"):
                np.testing.assert_allclose(batch[name][i], one[name], atol=2e-4)
            v = mesh.vertices.shape[0]
            assert np.all(batch["H"][i, v:] == 0) and np.all(batch["k"][i, v:] == 0)
