"""Polygon meshes: what they check, and triangles from and to them."""

import jax
import numpy as np
import pytest
import trimesh

from jaxgeom import GeometryError, PolygonMesh, TriangleMesh
from jaxgeom.meshes import icosphere

from .meshes_for_tests import cube, house


def test_fans_cover_the_same_surface(x64):
    box, pyramid = cube().triangulate(), house().triangulate()
    assert box.faces.shape == (12, 3) and pyramid.faces.shape == (3 + 10 + 5, 3)
    told = trimesh.Trimesh(box.vertices, np.asarray(box.faces), process=False)
    assert told.is_watertight and abs(told.volume - 1) < 1e-15
    first = np.asarray(house().faces[0])[0]
    np.testing.assert_array_equal(
        pyramid.faces[:3], first[[[0, 1, 2], [0, 2, 3], [0, 3, 4]]]
    )


def test_triangles_there_and_back():
    mesh = icosphere(0)
    told = TriangleMesh(
        np.concatenate([mesh.vertices, np.zeros((2, 3))]),
        np.concatenate([mesh.faces, np.full((3, 3), 14)]),
        attributes={"x": np.arange(14.0)},
        num_vertices=12,
        num_faces=20,
    )
    polygons = PolygonMesh.from_triangles(told)
    assert polygons.num_faces == 20
    back = polygons.triangulate()
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_array_equal(back.attributes["x"], np.arange(12.0))


def test_a_mesh_is_a_tree_of_arrays():
    moved = jax.jit(lambda m: jax.tree.map(lambda x: x + 0, m))(house())
    assert isinstance(moved, PolygonMesh)
    np.testing.assert_array_equal(moved.faces[1], house().faces[1])
    many = jax.vmap(lambda v: PolygonMesh(v, house().faces).triangulate().vertices)(
        np.zeros((2, 11, 3))
    )
    assert many.shape == (2, 11, 3)


POINTS = np.zeros((5, 3))
BAD = {
    "flat vertices": (
        lambda: PolygonMesh(POINTS[:, :2], ()),
        "vertices must have shape",
    ),
    "two corners": (lambda: PolygonMesh(POINTS, np.array([[0, 1]])), "k >= 3 corners"),
    "reals": (lambda: PolygonMesh(POINTS, np.zeros((1, 4))), "integer arrays"),
    "one face alone": (
        lambda: PolygonMesh(POINTS, np.arange(4)),
        "each array of faces",
    ),
    "beyond": (lambda: PolygonMesh(POINTS, np.array([[0, 1, 5]])), "vertices 0 ... 4"),
    "below": (lambda: PolygonMesh(POINTS, np.array([[0, 1, -1]])), "vertices 0 ... 4"),
    "two of a kind": (
        lambda: PolygonMesh(POINTS, (np.array([[0, 1, 2]]), np.array([[0, 1, 3]]))),
        "one array of faces for each number",
    ),
    "attribute": (
        lambda: PolygonMesh(POINTS, np.array([[0, 1, 2]]), {"x": np.zeros(4)}),
        "attribute 'x' must have shape",
    ),
}


@pytest.mark.parametrize("case", BAD.values(), ids=BAD.keys())
def test_bad_polygon_meshes_are_errors(case):
    with pytest.raises(GeometryError, match=case[1]):
        case[0]()
