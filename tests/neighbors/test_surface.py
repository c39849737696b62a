"""The closest point of a mesh, against trimesh's triangle kernel on all faces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxgeom._core import RESULTS
from jaxgeom.neighbors import closest_on_mesh
from jaxgeom.shapes import TriangleMesh


def _bumpy(dtype=np.float32):
    peer = trimesh.creation.icosphere(subdivisions=3, radius=1.7)
    v = peer.vertices
    v = v * (1 + 0.2 * np.sin(5 * v[:, :1]) * np.cos(4 * v[:, 1:2])) * [1, 0.3, 2]
    return TriangleMesh(jnp.asarray(v + [3, 1, -2], dtype), jnp.asarray(peer.faces))


def _queries(mesh, n, seed=0):
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    unit = np.random.default_rng(seed).uniform(-0.3, 1.3, (n, 3))
    return low + jnp.asarray(unit, mesh.vertices.dtype) * (high - low)


def _peer_distances(mesh, queries):
    corners = np.asarray(mesh.vertices, float)[np.asarray(mesh.faces)]
    near = lambda q: trimesh.triangles.closest_point(
        corners, np.broadcast_to(q, (len(corners), 3))
    )
    return np.array(
        [
            np.linalg.norm(near(q) - q, axis=1).min()
            for q in np.asarray(queries, dtype=float)
        ]
    )


def test_equals_trimesh():
    mesh = _bumpy()
    queries = _queries(mesh, 200)
    out = jax.jit(closest_on_mesh)(mesh, queries)
    np.testing.assert_allclose(
        out.distances, _peer_distances(mesh, queries), rtol=1e-5, atol=1e-6
    )
    corners = mesh.triangles()[out.faces]
    np.testing.assert_allclose(
        jnp.einsum("qi,qid->qd", out.barycentric, corners), out.points, atol=1e-6
    )
    assert (out.barycentric >= 0).all()
    np.testing.assert_allclose(out.barycentric.sum(axis=1), 1, atol=1e-6)
    gap = jnp.linalg.norm(queries - out.points, axis=1)
    np.testing.assert_allclose(gap, out.distances, atol=1e-6)


def test_padding_slivers_and_empty_meshes():
    mesh = _bumpy()
    v, f = mesh.vertices.shape[0], mesh.faces.shape[0]
    flat = jnp.asarray([[0, 0, 0], [1, 1, 2], [5, 6, 5]])
    faces = jnp.concatenate([mesh.faces, flat, jnp.full((29, 3), v)])
    queries = _queries(mesh, 50)
    padded = TriangleMesh(mesh.vertices, faces, num_faces=jnp.int32(f + 3))
    out = closest_on_mesh(padded, queries)
    some = TriangleMesh(mesh.vertices, faces[: f + 3])
    np.testing.assert_allclose(
        out.distances, closest_on_mesh(some, queries).distances, rtol=1e-5
    )
    assert (out.faces < f + 3).all()
    none = closest_on_mesh(
        TriangleMesh(mesh.vertices, faces, num_faces=jnp.int32(0)), queries
    )
    assert not none.mask.any()
    assert bool(none.result == RESULTS.no_surface)


def test_gradients(x64):
    mesh = _bumpy(np.float64)
    queries = _queries(mesh, 40)

    def loss(vertices, queries):
        moved = TriangleMesh(vertices, mesh.faces)
        out = closest_on_mesh(moved, queries)
        return jnp.sum(jnp.sin(out.distances)) + jnp.sum(jnp.cos(3 * out.points))

    value = jax.jit(loss)
    slopes = jax.jit(jax.grad(loss, argnums=(0, 1)))(mesh.vertices, queries)
    keys = jax.random.split(jax.random.key(1))
    ways = [
        jax.random.normal(k, x.shape)
        for k, x in zip(keys, (mesh.vertices, queries), strict=True)
    ]
    at = lambda h: value(mesh.vertices + h * ways[0], queries + h * ways[1])
    numeric = (at(1e-6) - at(-1e-6)) / 2e-6
    given = sum(jnp.sum(s * w) for s, w in zip(slopes, ways, strict=True))
    np.testing.assert_allclose(given, numeric, rtol=1e-5)


def test_the_gradient_is_finite_on_the_surface():
    mesh = _bumpy()
    distance = lambda q: closest_on_mesh(mesh, q).distances.sum()
    slope = jax.grad(distance)(mesh.vertices[:30])
    assert jnp.isfinite(slope).all()


def test_real_mesh(data):
    peer = trimesh.load(data / "meshes" / "horse.ply", process=False)
    mesh = TriangleMesh(
        jnp.asarray(peer.vertices, jnp.float32), jnp.asarray(peer.faces)
    )
    queries = _queries(mesh, 60, seed=5)
    out = jax.jit(closest_on_mesh)(mesh, queries)
    want = _peer_distances(mesh, queries)
    np.testing.assert_allclose(out.distances, want, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_vmap_is_a_loop():
    count = 33
    mesh = _bumpy()
    queries = _queries(mesh, 2 * count).reshape(2, count, 3)
    batch = jax.jit(jax.vmap(closest_on_mesh, in_axes=(None, 0)))(mesh, queries)
    for i in range(2):
        alone = closest_on_mesh(mesh, queries[i])
        np.testing.assert_allclose(
            batch.distances[i], alone.distances, rtol=1e-5, atol=1e-6
        )
