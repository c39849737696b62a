"""Signs at faces, edges and vertices; winding numbers; against trimesh."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxgeom._core import RESULTS
from jaxgeom.neighbors import (
    Exact,
    Hierarchical,
    Winding,
    inside,
    signed_distance,
    winding_number,
)
from jaxgeom.shapes import TriangleMesh

OCTAHEDRON = trimesh.Trimesh(
    np.concatenate([np.eye(3), -np.eye(3)]) * [1.3, 0.7, 2.1] + [3, -1, 2],
    [[i, j, k] for i, j, k in [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2)]]
    + [[j, i, k] for i, j, k in [(0, 1, 5), (1, 3, 5), (3, 4, 5), (4, 0, 5)]],
)
# A blade: two long sides that meet at less than two degrees.
WEDGE = trimesh.convex.convex_hull(
    [[0, 0, 0], [0, 3, 0], [4, 0, 0.06], [4, 3, 0.06], [4, 0, -0.06], [4, 3, -0.06]]
)
# A vertex where the normal of one face has the wrong sign (the figure of the paper).
NOTCHED = trimesh.Trimesh(
    *(lambda m: (np.where(np.arange(8)[:, None] == 7, 0.1, m.vertices), m.faces))(
        trimesh.creation.box([2.0, 2.2, 1.6])
    )
)
MESHES = {
    "cube": trimesh.creation.box([1.2, 0.8, 2.0]),
    "octahedron": OCTAHEDRON,
    "wedge": WEDGE,
    "notched": NOTCHED,
}


def _mesh(peer, dtype=np.float32):
    return TriangleMesh(
        jnp.asarray(peer.vertices, dtype), jnp.asarray(np.asarray(peer.faces))
    )


def _features(peer):
    """Points of faces, edges and vertices, moved off in all directions."""
    rng = np.random.default_rng(4)
    edges = peer.vertices[peer.edges_unique].mean(axis=1)
    base = np.concatenate([peer.triangles_center, edges, peer.vertices])
    base = np.repeat(base, 6, axis=0)
    way = rng.normal(size=base.shape)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return base + rng.choice([0.01, 0.1, 1.0], (len(base), 1)) * way


def _peer_signed(peer, queries):
    """trimesh's closest points on all faces; the sign by crossings of an odd ray."""
    queries = np.asarray(queries, float)
    f = len(peer.faces)
    pairs = np.repeat(peer.triangles, len(queries), axis=0), np.tile(queries, (f, 1))
    feet = trimesh.triangles.closest_point(*pairs)
    far = np.linalg.norm(feet - pairs[1], axis=1).reshape(f, -1).min(axis=0)
    a, b, c = np.moveaxis(peer.triangles, 1, 0)
    ray = np.broadcast_to([0.3, -0.5, 0.81], a.shape)
    columns = np.stack([b - a, c - a, ray])
    u, v, t = np.linalg.solve(
        np.moveaxis(columns, 0, 2)[None], (queries[:, None] - a)[..., None]
    )[..., 0].transpose(2, 0, 1)
    crossings = np.sum((u > 0) & (v > 0) & (u + v < 1) & (t > 0), axis=1)
    return np.where(crossings % 2, -far, far)


signed = jax.jit(signed_distance)
winding = jax.jit(winding_number)


@pytest.mark.parametrize("name", MESHES)
def test_sign_and_winding_agree_with_trimesh(name):
    peer = MESHES[name]
    assert peer.is_watertight and peer.volume > 0
    queries = np.resize(_features(peer), (192, 3)).astype(np.float32)
    want = _peer_signed(peer, queries)
    found = signed(_mesh(peer), queries)
    rounding = 8 * np.finfo(np.float32).eps * np.abs(queries).max()
    np.testing.assert_allclose(found.distances, want, rtol=1e-5, atol=rounding)
    around = winding(_mesh(peer), queries)
    np.testing.assert_allclose(around, want < 0, atol=1e-4)
    assert 0.02 < np.mean(want < 0) < 0.98
    zeros = np.sum(np.asarray(found.closest.barycentric) == 0, axis=1)
    assert {0, 1, 2} <= set(zeros.tolist())


def test_gradients_are_central_differences(x64):
    peer = MESHES["octahedron"]
    mesh, queries = _mesh(peer, float), jnp.asarray(_features(peer)[:48])
    ways = [
        jax.random.normal(jax.random.key(i), x.shape)
        for i, x in enumerate((mesh.vertices, queries))
    ]

    def loss(vertices, points):
        moved = TriangleMesh(vertices, mesh.faces)
        near = signed_distance(moved, points).distances
        around = winding_number(moved, points)
        return jnp.sum(jnp.sin(near)), jnp.sum(jnp.sin(3 * around))

    @jax.jit
    def both(h):
        at = lambda t: loss(mesh.vertices + t * ways[0], queries + t * ways[1])
        up, down = at(h), at(-h)
        return jax.jvp(at, (0.0,), (1.0,))[1], [
            (u - d) / (2 * h) for u, d in zip(up, down, strict=True)
        ]

    exact, numeric = both(1e-6)
    np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-8)


def test_gradient_on_the_surface_is_the_normal():
    peer = MESHES["cube"]
    points = jnp.asarray([[0.6, 0.1, 0.3], [0.6, 0.4, 0.2], [-0.6, -0.4, -1.0]])
    loss = lambda q: signed_distance(_mesh(peer), q).distances.sum()
    normals = np.asarray([[1, 0, 0], [1, 1, 0], [-1, -1, -1]]) / np.sqrt(
        [[1], [2], [3]]
    )
    np.testing.assert_allclose(jax.grad(loss)(points), normals, atol=1e-6)


def test_padding_open_and_empty_meshes():
    mesh = _mesh(MESHES["cube"])
    faces = jnp.concatenate([mesh.faces, jnp.full((5, 3), 8, jnp.int32)])
    queries = jnp.asarray(_features(MESHES["cube"])[:40], jnp.float32)
    padded = TriangleMesh(mesh.vertices, faces, num_faces=jnp.int32(12))
    alone = signed_distance(mesh, queries).distances
    np.testing.assert_array_equal(signed_distance(padded, queries).distances, alone)
    np.testing.assert_allclose(
        winding_number(padded, queries), winding_number(mesh, queries), atol=1e-6
    )
    opened = TriangleMesh(mesh.vertices, mesh.faces[:10])
    assert 0.5 < winding_number(opened, jnp.zeros((1, 3)))[0] < 1
    none = TriangleMesh(mesh.vertices, faces, num_faces=jnp.int32(0))
    lost = signed_distance(none, queries)
    assert (
        jnp.isposinf(lost.distances).all()
        and (winding_number(none, queries) == 0).all()
    )
    assert bool(lost.result == RESULTS.no_surface)


def _bumpy(dtype):
    peer = trimesh.creation.icosphere(subdivisions=3, radius=1.7)
    v = peer.vertices * (1 + 0.2 * np.sin(5 * peer.vertices[:, :1]))
    v = v * [1, 0.3, 2] + [3, 1, -2]
    return TriangleMesh(jnp.asarray(v, dtype), jnp.asarray(peer.faces[:-30]))


@pytest.mark.slow
def test_hierarchical_winding_converges_to_the_exact_one():
    mesh = _bumpy(np.float32)
    rng = np.random.default_rng(3)
    points = rng.uniform(-2, 2, (400, 3)) * [1, 0.4, 2] + [3, 1, -2]
    points = jnp.asarray(points, jnp.float32).at[7].set(jnp.nan)
    exact = jax.jit(winding_number)(mesh, points)

    @jax.jit
    def error(beta):
        found = winding_number(mesh, points, method=Hierarchical(beta))
        return jnp.nanmax(jnp.abs(found - exact)), jnp.isnan(found)

    worst = [float(error(beta)[0]) for beta in (1.5, 3.0, 6.0)]
    # Three terms: doubling beta divides the error by about 2^4.
    assert worst[0] > 8 * worst[1] > 64 * worst[2], worst
    assert worst[1] < 1e-3 and worst[2] < 1e-4, worst
    assert list(jnp.flatnonzero(error(2.0)[1])) == [7]
    clear = jnp.abs(exact - 0.5) > 0.01
    agree = jax.jit(inside)(mesh, points) == (exact > 0.5)
    assert agree[clear].all() and (exact > 0.5).any()


@pytest.mark.slow
def test_signs_by_winding_and_their_gradients(x64):
    mesh = _bumpy(np.float64)
    rng = np.random.default_rng(5)
    points = rng.uniform(-2, 2, (40, 3)) * [1, 0.4, 2] + [3, 1, -2]
    points = jnp.asarray(points)
    ways = [
        jax.random.normal(jax.random.key(i), x.shape)
        for i, x in enumerate((mesh.vertices, points))
    ]

    @jax.jit
    def both(h):
        def at(t):
            moved = TriangleMesh(mesh.vertices + t * ways[0], mesh.faces)
            there = points + t * ways[1]
            out = signed_distance(moved, there, sign=Winding())
            return out.distances

        slope = jax.jvp(at, (0.0,), (1.0,))[1]
        return at(0.0), slope, (at(h) - at(-h)) / (2 * h)

    found, exact, numeric = both(1e-6)
    np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-8)
    around = winding_number(mesh, points, method=Exact())
    np.testing.assert_array_equal(found < 0, around > 0.5)
