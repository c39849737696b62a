"""Discs flattened onto the square: no folds, and the inverse of smooth maps."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import Delaunay

from jaxgeom import GeometryError, TriangleMesh
from jaxgeom.meshes import disc_parameters, icosphere, torus_mesh


def _areas(uv, faces):
    a, b, c = (uv[faces[:, i]] for i in range(3))
    (x, y), (z, w) = (b - a).T, (c - a).T
    return (x * w - y * z) / 2


def _square(n=12, seed=0):
    """A square of random triangles, its boundary evenly divided."""
    rng = np.random.default_rng(seed)
    side = np.linspace(0, 1, n)
    rim = [(t, 0) for t in side[:-1]] + [(1, t) for t in side[:-1]]
    rim += [(1 - t, 1) for t in side[:-1]] + [(0, 1 - t) for t in side[:-1]]
    inner = 0.03 + 0.94 * rng.uniform(size=(n * n, 2))
    uv = np.concatenate([np.array(rim), inner])
    # A bulge of the rim keeps slivers along it out of the hull.
    middle = uv - 0.5
    bulge = middle * (1 + 1e-6 * (1 - np.sum(middle**2, axis=1)))[:, None]
    faces = Delaunay(bulge).simplices
    turned = _areas(uv, faces) < 0
    faces[turned] = faces[turned][:, ::-1]
    return uv, faces[_areas(uv, faces) > 1e-9].astype(np.int32)


def test_a_plane_square_is_itself(x64):
    """Mean value coordinates reproduce linear functions."""
    uv, faces = _square()
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    points = 2.5 * np.c_[uv, np.zeros(len(uv))] @ turn.T + [3, -1, 2]
    found = disc_parameters(TriangleMesh(points, faces))
    # Which of the four corners comes first is free.
    turns = [uv - 0.5]
    for _ in range(3):
        turns.append(np.stack([-turns[-1][:, 1], turns[-1][:, 0]], axis=1))
    assert min(np.abs(found - 0.5 - x).max() for x in turns) < 1e-9


def test_a_curved_sheet_has_no_folds():
    uv, faces = _square(seed=2)
    x, y = uv.T
    points = np.stack([x, 2 * y, 0.4 * np.sin(5 * x) * np.cos(4 * y)], axis=1)
    found = disc_parameters(TriangleMesh(points, faces))
    on_rim = np.any((uv == 0) | (uv == 1), axis=1)
    whole = ~on_rim[faces].all(axis=1)
    assert _areas(found, faces)[whole].min() > 0
    np.testing.assert_allclose(_areas(found, faces).sum(), 1, rtol=1e-9)
    assert np.all((found >= 0) & (found <= 1))


def test_half_a_ball_covers_the_square_once():
    ball = icosphere(3)
    low = np.asarray(ball.vertices)[:, 2][np.asarray(ball.faces)].min(axis=1) < 0.2
    faces = np.asarray(ball.faces)[~low]
    kept, faces = np.unique(faces, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    found = disc_parameters(TriangleMesh(np.asarray(ball.vertices)[kept], faces))
    assert _areas(found, faces).min() > -1e-12
    np.testing.assert_allclose(_areas(found, faces).sum(), 1, rtol=1e-9)


def test_padding_is_cut_off_and_one_triangle_is_enough():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]], float)
    mesh = TriangleMesh(
        jnp.asarray(corners), np.array([[0, 1, 2], [4, 4, 4]]), None, None, 3, 1
    )
    found = disc_parameters(mesh)
    assert found.shape == (3, 2) and np.isfinite(found).all()


def test_what_is_no_disc_is_refused():
    ball, ring = icosphere(1), torus_mesh(1.0, 0.3, around=8, across=6)
    holed = TriangleMesh(ball.vertices, np.delete(ball.faces, [0, 50], axis=0))
    lone = TriangleMesh(np.eye(4, 3), np.array([[0, 1, 2]]))
    broken = TriangleMesh(np.array([[0, 0, 0], [1, 0, 0], [np.nan, 1, 0]]), lone.faces)
    for mesh, why in (
        (ball, "boundary loops 0"),
        (ring, "Euler characteristic 0"),
        (holed, "boundary loops 2"),
        (lone, "1 unreferenced vertices"),
        (broken, "1 nonfinite vertices"),
    ):
        with pytest.raises(GeometryError, match=why):
            disc_parameters(mesh)
