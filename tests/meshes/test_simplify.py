"""Clustering keeps what is closed closed and what is sharp sharp."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom.meshes import box_mesh, cluster_vertices, decimate, icosphere, report
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import (
    closed_meshes,
    joined,
    moved,
    sized,
    slope_and_difference,
    stacked,
)

V, F = 400, 780
RUN = jax.jit(cluster_vertices)


def run(mesh, cell):
    """The clusters, with an attribute that is one on all vertices."""
    like = sized(mesh, V, F)
    counts = {"num_vertices": like.num_vertices, "num_faces": like.num_faces}
    ones = {"one": np.where(np.arange(V) < int(like.num_vertices), 1.0, 5.0)}
    return RUN(TriangleMesh(like.vertices, like.faces, None, ones, **counts), cell)


def directed_balance(mesh):
    """How often each directed edge occurs, less how often its opposite does."""
    faces = np.asarray(mesh.faces)[: int(mesh.num_faces)]
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    edge, number = np.unique(
        np.sort(np.stack([start, end], -1)), axis=0, return_inverse=True
    )
    return np.bincount(
        number.ravel(), weights=np.where(start < end, 1, -1), minlength=len(edge)
    )


@pytest.mark.parametrize("cell", [0.31, 0.55, 0.9])
def test_closed_meshes_stay_closed(x64, cell):
    ball = icosphere(2, radius=1.3)
    sheets = joined(ball, moved(closed_meshes()["torus"], (5.0, 0, 0)))
    out = run(sheets, cell)
    assert 0 < int(out.num_vertices) < sheets.vertices.shape[0]
    assert 0 < int(out.num_faces) < sheets.faces.shape[0]
    assert np.all(directed_balance(out) == 0)
    # The mean of ones is one, whatever the padding holds.
    here = np.arange(V) < int(out.num_vertices)
    np.testing.assert_allclose(out.attributes["one"], here)
    found = report(out)
    assert found.degenerate_faces.size == found.unreferenced_vertices.size == 0
    assert np.all(np.asarray(out.vertices)[int(out.num_vertices) :] == 0)
    assert np.all(np.asarray(out.faces)[int(out.num_faces) :] == V)


def test_a_box_stays_a_box(x64):
    box = box_mesh((0.7, 1.1, 0.9), subdivisions=3)
    out = run(box, 0.2).trim()
    half = np.array([0.35, 0.55, 0.45])
    away = np.abs(np.asarray(out.vertices)) - half
    # On the faces that meet in their cells, up to the weight of the mean.
    assert np.max(np.abs(np.max(away, axis=1))) < 2e-3
    on = np.abs(away) < 5e-3
    assert np.sum(on.sum(axis=1) == 3) == 8 and np.sum(on.sum(axis=1) >= 2) > 20
    assert out.faces.shape[0] < 300 and report(out).is_clean


def test_tiny_cells_change_nothing(x64):
    mesh = closed_meshes()["torus"]
    out = run(mesh, 1e-3).trim()
    assert out.faces.shape == mesh.faces.shape
    there = lambda m: np.sort(
        np.asarray(m.vertices)[np.asarray(m.faces)].mean(axis=1), axis=0
    )
    np.testing.assert_allclose(there(out), there(mesh), atol=1e-9)


def test_one_cell_leaves_nothing(x64):
    out = run(closed_meshes()["torus"], 99.0)
    assert out.num_faces == out.num_vertices == 0


def test_gradients_are_central_differences(x64):
    mesh = sized(closed_meshes()["torus"], V, F, garbage=5.0)
    counts = {"num_vertices": mesh.num_vertices, "num_faces": mesh.num_faces}
    generator = np.random.default_rng(0)
    probe, way = generator.normal(size=(2, V, 3))
    # The first vertices fix the grid of cells.
    low = np.argmin(np.asarray(mesh.vertices)[:117], axis=0)
    way[low] = 0
    value = lambda x: jnp.sum(
        probe * cluster_vertices(TriangleMesh(x, mesh.faces, **counts), 0.5).vertices
    )
    slope, exact, numeric = slope_and_difference(value, mesh.vertices, way, step=1e-7)
    assert exact == pytest.approx(numeric, rel=1e-5)
    assert np.all(slope[117:] == 0)


@pytest.mark.slow
def test_a_batch_in_single_precision_is_each_in_double():
    meshes = [closed_meshes()["torus"], icosphere(2, radius=1.3)]
    small = [sized(m, V, F, dtype=np.float32) for m in meshes]
    batch = jax.jit(jax.vmap(cluster_vertices, (0, None)))(stacked(*small), 0.47)
    with jax.enable_x64(True):
        for i, mesh in enumerate(meshes):
            one = run(mesh, 0.47)
            assert batch.num_faces[i] == one.num_faces
            np.testing.assert_array_equal(batch.faces[i], one.faces)
            np.testing.assert_allclose(batch.vertices[i], one.vertices, atol=1e-3)


def test_edge_collapse_says_what_it_needs(monkeypatch):
    mesh = icosphere(1)
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    with pytest.raises(ValueError, match="needs the library fast_simplification"):
        decimate(mesh, 40)
    with pytest.raises(ValueError, match="num_faces must be at least 1"):
        decimate(mesh, 0)


def test_edge_collapse_by_the_library():
    pytest.importorskip("fast_simplification")
    mesh = icosphere(3)
    out = decimate(mesh, 400)
    assert 380 <= out.faces.shape[0] <= 420 and report(out).is_clean
    assert decimate(out, 5000).faces.shape == out.faces.shape
