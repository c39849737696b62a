"""First hits of rays, against a solver of all pairs in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh

from jaxgeom import GeometryError
from jaxgeom._core import RESULTS
from jaxgeom.neighbors import cast_rays, index_surface
from jaxgeom.shapes import TriangleMesh

CENTER = np.asarray([3, 1, -2])
cast = jax.jit(cast_rays)


def _bumpy(dtype=np.float32):
    peer = trimesh.creation.icosphere(subdivisions=3, radius=1.7)
    v = peer.vertices * (1 + 0.2 * np.sin(5 * peer.vertices[:, :1])) * [1, 0.3, 2]
    return TriangleMesh(jnp.asarray(v + CENTER, dtype), jnp.asarray(peer.faces))


def _rays(n, seed=0):
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-3, 3, (n, 3)) + CENTER
    aims = rng.normal(0, 0.7, (n, 3)) * [1, 0.3, 2] + CENTER
    return origins.astype(np.float32), (2.5 * (aims - origins)).astype(np.float32)


def _peer(mesh, origins, ways):
    """The least t over all faces, by linear systems in double precision."""
    a, b, c = np.moveaxis(
        np.asarray(mesh.vertices, float)[np.asarray(mesh.faces)], 1, 0
    )
    out = []
    for origin, way in zip(np.float64(origins), np.float64(ways), strict=True):
        columns = np.stack([b - a, c - a, np.broadcast_to(-way, a.shape)], axis=-1)
        u, v, t = np.linalg.solve(columns, (origin - a)[..., None])[..., 0].T
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0)
        out.append(np.min(t, where=hit, initial=np.inf))
    return np.array(out)


def test_first_hits_are_those_of_all_pairs():
    mesh, (origins, ways) = _bumpy(), _rays(300)
    want = _peer(mesh, origins, ways)
    out = cast(mesh, origins, ways)
    np.testing.assert_array_equal(out.mask, np.isfinite(want))
    assert 0.2 < np.mean(np.isfinite(want)) < 0.98
    np.testing.assert_allclose(out.t, want, rtol=2e-5)
    hit = np.asarray(out.mask)
    there = origins[hit] + np.asarray(out.t)[hit, None] * ways[hit]
    np.testing.assert_allclose(out.points[hit], there, atol=2e-5)
    corners = mesh.triangles()[out.faces[hit]]
    again = jnp.einsum("qi,qid->qd", out.barycentric[hit], corners)
    np.testing.assert_allclose(again, out.points[hit], atol=2e-6)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(out.normals[hit], normals, atol=1e-4)
    assert (np.asarray(out.faces)[~hit] == mesh.faces.shape[0]).all()


def test_no_ray_slips_through_an_edge_or_a_vertex():
    mesh = _bumpy()
    v, f = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    rng = np.random.default_rng(2)
    share = rng.uniform(0, 1, (3 * len(f), 1)).astype(np.float32)
    start, end = v[f.reshape(-1)], v[np.roll(f, -1, axis=1).reshape(-1)]
    targets = np.concatenate([v, share * start + (1 - share) * end])
    origins = rng.uniform(-0.2, 0.2, targets.shape).astype(np.float32) + CENTER
    origins = np.asarray(origins, np.float32)
    out = cast(mesh, origins, targets - origins)
    assert out.mask.all()
    # The surface is star-shaped about its center: the first hit is the target.
    ways = targets - origins
    slope = np.sum(out.normals * ways, axis=1) / np.linalg.norm(ways, axis=1)
    assert (np.abs(out.t - 1) * np.abs(slope) < 4e-6).all()
    outward = cast(mesh, targets + 3 * (targets - origins), origins - targets)
    assert outward.mask.all()


def test_rays_along_the_axes_in_and_through_the_faces_of_a_box():
    box = trimesh.creation.box([1, 2, 3])
    mesh = TriangleMesh(jnp.asarray(box.vertices, jnp.float32), jnp.asarray(box.faces))
    x, y = np.meshgrid([-0.5, -0.25, 0, 0.25, 0.5], [-1, -0.5, 0, 0.5, 1])
    origins = np.stack([x.ravel(), y.ravel(), np.full(25, -5)], axis=1)
    up = np.broadcast_to([0, 0, 2.0], origins.shape)
    out = cast(mesh, origins, up)
    np.testing.assert_allclose(out.t, 1.75)
    away = cast(mesh, origins, -up)
    assert not away.mask.any() and jnp.isposinf(away.t).all()


def test_padding_bad_rays_and_empty_meshes():
    mesh, (origins, ways) = _bumpy(), _rays(300)
    v, f = mesh.vertices.shape[0], mesh.faces.shape[0]
    faces = jnp.concatenate([mesh.faces, jnp.full((29, 3), v)])
    padded = TriangleMesh(mesh.vertices, faces, num_faces=jnp.int32(f))
    bad, lost = ways.copy(), origins.copy()
    bad[0], bad[1], lost[2] = 0, np.nan, np.inf
    out, want = cast(padded, lost, bad), cast(mesh, origins, ways)
    assert not out.mask[:3].any()
    np.testing.assert_array_equal(out.mask[3:], want.mask[3:])
    np.testing.assert_array_equal(out.t[3:], want.t[3:])
    none = TriangleMesh(mesh.vertices, faces, num_faces=jnp.int32(0))
    nothing = cast(none, origins, ways)
    assert not nothing.mask.any() and bool(nothing.result == RESULTS.no_surface)
    with pytest.raises(GeometryError, match="directions must have shape"):
        cast_rays(mesh, origins, ways[:4])


def test_gradients_are_central_differences(x64):
    mesh, (origins, ways) = _bumpy(float), _rays(60)
    parts = mesh.vertices, jnp.asarray(origins, float), jnp.asarray(ways, float)
    turns = [jax.random.normal(jax.random.key(i), x.shape) for i, x in enumerate(parts)]

    @jax.jit
    def both(h):
        def at(s):
            vertices, here, there = (
                x + s * d for x, d in zip(parts, turns, strict=True)
            )
            out = cast_rays(TriangleMesh(vertices, mesh.faces), here, there)
            hit = out.mask[:, None]
            t = jnp.where(out.mask, out.t, 0)
            return jnp.concatenate([t[:, None], jnp.where(hit, out.barycentric, 0)], 1)

        return jax.jvp(at, (0.0,), (1.0,))[1], (at(h) - at(-h)) / (2 * h)

    exact, numeric = both(1e-7)
    same = jnp.max(jnp.abs(numeric), axis=1) < 1e3
    assert same.mean() > 0.95
    np.testing.assert_allclose(exact[same], numeric[same], rtol=1e-4, atol=1e-5)


@pytest.mark.slow
def test_vmap_is_a_loop():
    mesh, (origins, ways) = _bumpy(), _rays(60)
    index = index_surface(mesh)
    pair = lambda x: jnp.asarray(x).reshape(2, 30, 3)
    batch = jax.jit(jax.vmap(cast_rays, in_axes=(None, 0, 0)))(
        index, pair(origins), pair(ways)
    )
    for i in range(2):
        alone = cast(index, pair(origins)[i], pair(ways)[i])
        np.testing.assert_array_equal(batch.faces[i], alone.faces)
        np.testing.assert_allclose(batch.t[i], alone.t, rtol=1e-5)
