"""Small meshes with all kinds of vertices, and tools to look at one of them closely."""

import functools

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from jaxgeom.shapes import PolygonMesh, TriangleMesh
from jaxgeom.subdivision import Creases, plan_subdivision


@functools.cache
def hull() -> TriangleMesh:
    """A closed mesh with vertices of 3, 4, 5, 6 and 8 edges."""
    found = ConvexHull(np.random.default_rng(1).normal(size=(30, 3)))
    names, faces = np.unique(found.simplices, return_inverse=True)
    vertices, faces = found.points[names], faces.reshape(-1, 3)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) < 0
    faces[inward] = faces[inward][:, ::-1]
    return TriangleMesh(vertices, faces.astype(np.int32))


@functools.cache
def bowl() -> TriangleMesh:
    """The hull with a hole where one vertex was.

    No inner edge joins two vertices of the border: there trimesh is wrong.
    """
    mesh = hull()
    links = edges_of(mesh)
    inside = lambda loop: np.isin(links, loop).all(axis=1).sum() == len(loop)
    top = next(v for v in range(30) if inside(ring(mesh, v)))
    kept = mesh.faces[~np.any(mesh.faces == top, axis=1)]
    kept = np.where(kept > top, kept - 1, kept)
    return TriangleMesh(np.delete(mesh.vertices, top, axis=0), kept)


@functools.cache
def cube() -> PolygonMesh:
    """The unit cube in six squares."""
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3, indexing="ij"), -1).reshape(-1, 3)
    squares = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6)]
    return PolygonMesh(corners, np.array([*squares, (0, 2, 6, 4), (1, 5, 7, 3)]))


@functools.cache
def house() -> PolygonMesh:
    """A closed mesh of pentagons, squares and triangles in general position."""
    angle = 2 * np.pi * np.arange(5) / 5
    ring = np.stack([np.cos(angle), 1.3 * np.sin(angle), 0 * angle], -1)
    tip = np.array([[0.1, 0.2, 2.1]])
    vertices = np.concatenate([ring, ring + [0.1, 0.0, 1.2], tip])
    i, j = np.arange(5), (np.arange(5) + 1) % 5
    squares = np.stack([i, j, j + 5, i + 5], -1)
    triangles = np.stack([i + 5, j + 5, np.full(5, 10)], -1)
    return PolygonMesh(vertices, (i[None, ::-1], squares, triangles))


def sheet() -> PolygonMesh:
    """Three by two squares, bent, with a border."""
    x, y = np.meshgrid(np.arange(4.0), np.arange(3.0), indexing="ij")
    vertices = np.stack([x, y, 0.3 * x**2 - 0.2 * x * y + 0.1 * y**2], -1).reshape(
        -1, 3
    )
    i, j = (k.ravel() for k in np.meshgrid(range(3), range(2), indexing="ij"))
    first = 3 * i + j
    return PolygonMesh(vertices, np.stack([first, first + 3, first + 4, first + 1], -1))


def valence(mesh):
    """The number of faces at every vertex."""
    return np.bincount(np.concatenate([f.ravel() for f in faces_of(mesh)]))


def faces_of(mesh):
    """All arrays of faces, as numpy."""
    groups = mesh.faces if isinstance(mesh.faces, tuple) else (mesh.faces,)
    return tuple(np.asarray(group) for group in groups)


def ring(mesh: TriangleMesh, vertex: int):
    """The neighbors of an inner vertex, counter-clockwise."""
    after = {}
    for face in np.asarray(mesh.faces).tolist():
        if vertex in face:
            i = face.index(vertex)
            after[face[(i + 1) % 3]] = face[(i + 2) % 3]
    out = [min(after)]
    while len(out) < len(after):
        out.append(after[out[-1]])
    return out


def gap(a, b):
    """How far two sets of points of equal number are from each other."""
    a, b = np.asarray(a), np.asarray(b)
    assert a.shape == b.shape
    return max(cKDTree(a).query(b)[0].max(), cKDTree(b).query(a)[0].max())


def edges_of(mesh):
    """All edges [e, 2], sorted, each once."""
    sides = [
        np.stack([f, np.roll(f, -1, axis=1)], -1).reshape(-1, 2) for f in faces_of(mesh)
    ]
    return np.unique(np.sort(np.concatenate(sides), axis=1), axis=0)


def refined(mesh, levels, scheme, creases=None):
    """Positions in numpy, faces and creases: nothing is compiled."""
    plan = plan_subdivision(mesh, levels, scheme=scheme, creases=creases)
    vertices = plan.operator.to_scipy() @ np.asarray(mesh.vertices)
    return vertices, faces_of(plan), plan.creases, plan.triangles


def follow(mesh, vertex, levels, scheme, creases=None):
    """A vertex after many levels, and the unit normals of the faces around it.

    Only the faces that touch those around the vertex are kept from level to level,
    centered at it and blown up by two, so that nothing is lost to rounding.
    """
    creases = creases or Creases()
    place, size = np.zeros(3), 1.0
    for _ in range(levels):
        vertices, faces, creases, flat = refined(mesh, 1, scheme, creases)
        faces, number = _near(faces, vertex, len(vertices))
        center, used = vertices[vertex], number < len(vertices)
        place = place + size * center
        size, vertex = size / 2, int(number[vertex])
        vertices = 2 * (vertices[used] - center)
        kind = TriangleMesh if flat else PolygonMesh
        mesh = kind(vertices, faces[0] if flat else faces)
        creases = _renamed(creases, number, mesh)
    return place, _normals_at(mesh, vertex)


def _near(faces, vertex, count):
    """The faces that touch a face at the vertex, and the new name of each vertex."""
    close = np.zeros(count, bool)
    for group in faces:
        close[group[np.any(group == vertex, axis=1)]] = True
    kept = [group[np.any(close[group], axis=1)] for group in faces]
    used = np.unique(np.concatenate([group.ravel() for group in kept]))
    number = np.full(count, count)
    number[used] = np.arange(len(used))
    return tuple(number[group] for group in kept if len(group)), number


def _renamed(creases, number, mesh):
    count = len(number)
    named = np.sort(number[creases.edges], axis=1)
    known = {tuple(edge) for edge in edges_of(mesh).tolist()}
    kept = np.array([tuple(edge) in known for edge in named.tolist()], bool)
    pins = number[creases.vertices]
    return Creases(
        named[kept],
        creases.sharpness[kept],
        pins[pins < count],
        creases.vertex_sharpness[pins < count],
    )


def _normals_at(mesh, vertex):
    out = []
    for group in faces_of(mesh):
        row, at = np.nonzero(group == vertex)
        ahead = mesh.vertices[group[row, (at + 1) % group.shape[1]]]
        behind = mesh.vertices[group[row, at - 1]]
        out.append(
            np.cross(ahead - mesh.vertices[vertex], behind - mesh.vertices[vertex])
        )
    normals = np.concatenate(out)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
