"""Components, compaction and trimming."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom.meshes import (
    AllVertices,
    AnyVertex,
    SurfaceArea,
    area,
    box_mesh,
    drop_small_components,
    icosphere,
    keep_faces,
    large_components,
    split,
    topology,
    trim_by_attribute,
)
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import closed_meshes, joined, moved, padded, peer, stacked


def specks():
    """A sphere of 320 faces, a small one of 20 faces, a large box of 12 faces."""
    return joined(
        moved(icosphere(0, radius=0.1), (3.0, 0, 0)),
        icosphere(2),
        moved(box_mesh((4.0, 5.0, 6.0)), (9.0, 0, 0)),
    )


def same_corners(a, b):
    np.testing.assert_array_equal(a.vertices[a.faces], b.vertices[b.faces])


def test_specks_are_dropped_by_faces():
    left = jax.jit(lambda m: drop_small_components(m, min_fraction=0.05))(specks())
    assert (left.num_faces, left.num_vertices) == (340, 12 + 162)
    same_corners(
        left.trim(), joined(moved(icosphere(0, radius=0.1), (3.0, 0, 0)), icosphere(2))
    )
    left = drop_small_components(specks(), min_fraction=1.0)
    same_corners(left.trim(), icosphere(2))


def test_specks_are_dropped_by_area():
    size = SurfaceArea()
    left = drop_small_components(specks(), min_fraction=0.05, size=size).trim()
    assert left.faces.shape[0] == 332
    left = drop_small_components(specks(), min_fraction=0.5, size=size).trim()
    same_corners(left, moved(box_mesh((4.0, 5.0, 6.0)), (9.0, 0, 0)))


@pytest.mark.slow
def test_split_agrees_with_trimesh():
    mesh = padded(specks())
    parts = split(mesh)
    assert [p.faces.shape[0] for p in parts] == [320, 20, 12]
    others = peer(specks()).split(only_watertight=True)
    areas = sorted(float(area(p)) for p in parts)
    np.testing.assert_allclose(areas, sorted(o.area for o in others), rtol=1e-5)
    assert all(bool(topology(p).is_watertight) for p in parts)
    assert split(mesh_without_faces()) == []


def mesh_without_faces():
    return TriangleMesh(jnp.ones((4, 3)), jnp.zeros((0, 3), jnp.int32))


def test_kept_faces_take_normals_and_attributes_along():
    mesh = closed_meshes()["box"]
    v = mesh.vertices.shape[0]
    names = {"color": mesh.vertices * 2, "number": jnp.arange(v)}
    mesh = TriangleMesh(mesh.vertices, mesh.faces, -mesh.vertices, names)
    keep = jnp.arange(mesh.faces.shape[0]) % 5 == 2
    small = keep_faces(mesh, keep)
    assert small.vertices.shape == mesh.vertices.shape
    assert jnp.all(small.faces[~small.face_mask] == v)
    small = small.trim()
    same_corners(small, TriangleMesh(mesh.vertices, mesh.faces[keep]))
    np.testing.assert_array_equal(small.normals, -small.vertices)
    np.testing.assert_array_equal(small.attributes["color"], 2 * small.vertices)
    number = small.attributes["number"]
    np.testing.assert_array_equal(mesh.vertices[number], small.vertices)


def test_gradient_reaches_kept_vertices_only():
    mesh = padded(specks())
    make = lambda x: TriangleMesh(
        x, mesh.faces, num_vertices=mesh.num_vertices, num_faces=mesh.num_faces
    )
    total = lambda x: jnp.sum(
        drop_small_components(make(x), min_fraction=1.0).vertices ** 2
    )
    gradient = jax.grad(total)(mesh.vertices)
    inner = jnp.zeros(mesh.vertices.shape[0], bool).at[12:174].set(True)
    expected = jnp.where(inner[:, None], 2 * mesh.vertices, 0)
    np.testing.assert_allclose(gradient, expected)


@pytest.mark.parametrize("rule", [AnyVertex(), AllVertices(), None])
def test_trimming_by_height(rule):
    mesh = padded(closed_meshes()["torus"])
    height = jnp.where(mesh.vertex_mask, mesh.vertices[:, 2], 0)
    cut = jax.jit(lambda m, h, t: trim_by_attribute(m, h, t, rule=rule))
    trimmed = cut(mesh, height, 2.2)
    low = np.asarray(height)[np.asarray(mesh.faces)[: int(mesh.num_faces)]] < 2.2
    gone = low.all(axis=1) if isinstance(rule, AllVertices) else low.any(axis=1)
    assert 0 < trimmed.num_faces == np.sum(~gone) < mesh.num_faces
    if not isinstance(rule, AllVertices):
        assert jnp.min(trimmed.trim().vertices[:, 2]) >= 2.2


def test_not_a_number_is_below_and_threshold_itself_is_not():
    mesh = icosphere(0)
    values = jnp.full(12, 0.5).at[3].set(jnp.nan)
    assert trim_by_attribute(mesh, values, 0.5).num_faces == 15
    assert trim_by_attribute(mesh, jnp.full(12, 0.5), 0.5).num_faces == 20
    with pytest.raises(ValueError, match="values must have shape"):
        trim_by_attribute(mesh, values[:5], 0.5)


def test_padding_changes_nothing():
    mesh = specks()
    small = drop_small_components(mesh, min_fraction=0.05).trim()
    same = drop_small_components(padded(mesh), min_fraction=0.05).trim()
    np.testing.assert_array_equal(small.vertices, same.vertices)
    np.testing.assert_array_equal(small.faces, same.faces)


def test_vmap_is_loop():
    pair = (joined(icosphere(0), box_mesh()), joined(box_mesh(), icosphere(0)))
    large = lambda m: large_components(m, min_fraction=0.7)
    batched = jax.vmap(large)(stacked(*pair))
    for i, mesh in enumerate(pair):
        np.testing.assert_array_equal(batched[i], large(mesh))
        assert jnp.sum(batched[i]) == 20
