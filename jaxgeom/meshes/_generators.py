"""Closed meshes of known area, volume and genus."""

import jax.numpy as jnp
import numpy as np

from .._core import GeometryError, message
from ..shapes import TriangleMesh


def icosphere(subdivisions: int = 3, *, radius: float = 1.0) -> TriangleMesh:
    """A sphere about the origin: an icosahedron whose faces are split in four.

    `subdivisions` splits give 20 * 4^subdivisions faces with vertices at `radius`.
    Raises `GeometryError` for a negative number of subdivisions.
    """
    _check_least("subdivisions", subdivisions, 0)
    vertices, faces = _icosahedron()
    for _ in range(subdivisions):
        vertices, faces = _split_in_four(vertices, faces)
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return _mesh(radius * vertices, faces)


def box_mesh(extents=(1.0, 1.0, 1.0), *, subdivisions: int = 0) -> TriangleMesh:
    """The surface of a box about the origin with sides `extents` [3].

    12 faces, each split in four `subdivisions` times. Raises `GeometryError` for a
    negative number of subdivisions.
    """
    _check_least("subdivisions", subdivisions, 0)
    vertices = _product((-0.5, 0.5))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6)]
    quads = np.array([*quads, (0, 2, 6, 4), (1, 5, 7, 3)])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    for _ in range(subdivisions):
        vertices, faces = _split_in_four(vertices, faces)
    return _mesh(vertices * np.asarray(extents), faces)


def torus_mesh(
    major: float = 1.0, minor: float = 0.25, *, around: int = 32, across: int = 16
) -> TriangleMesh:
    """A torus about the z axis: a tube of radius `minor` at distance `major`.

    2 * `around` * `across` faces; `around` counts along the circle of radius `major`.
    Raises `GeometryError` for fewer than 3 segments either way.
    """
    _check_least("around", around, 3)
    _check_least("across", across, 3)
    i, j = (x.ravel() for x in np.meshgrid(range(around), range(across), indexing="ij"))
    u, v = 2 * np.pi * i / around, 2 * np.pi * j / across
    reach = major + minor * np.cos(v)
    vertices = np.stack([reach * np.cos(u), reach * np.sin(u), minor * np.sin(v)], -1)
    node = lambda di, dj: (i + di) % around * across + (j + dj) % across
    lower = np.stack([node(0, 0), node(1, 0), node(1, 1)], -1)
    upper = np.stack([node(0, 0), node(1, 1), node(0, 1)], -1)
    return _mesh(vertices, np.concatenate([lower, upper]))


def _icosahedron():
    golden = (1 + np.sqrt(5)) / 2
    signs = [(-1, -golden), (-1, golden), (1, -golden), (1, golden)]
    rows = [np.roll((0, a, b), turn) for turn in range(3) for a, b in signs]
    vertices = np.array(rows, float)
    triples = _product(range(12))
    triples = triples[(triples[:, 0] < triples[:, 1]) & (triples[:, 0] < triples[:, 2])]
    a, b, c = (vertices[triples[:, d]] for d in range(3))
    # Faces are the triples at mutual distance 2 (the edge), seen from outside.
    sides = np.stack([a - b, b - c, c - a])
    near = np.all(np.isclose(np.linalg.norm(sides, axis=-1), 2), axis=0)
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) > 0
    return vertices / np.sqrt(1 + golden**2), triples[near & outward]


def _product(values):
    """All triples of `values`."""
    return np.stack(np.meshgrid(*[values] * 3, indexing="ij"), -1).reshape(-1, 3)


def _split_in_four(vertices, faces):
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1), axis=-1)
    unique, middle = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    middle = middle.reshape(-1, 3) + len(vertices)
    vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
    fan = [
        np.stack([faces[:, d], middle[:, d], middle[:, d - 1]], -1) for d in range(3)
    ]
    return vertices, np.concatenate([*fan, middle])


def _mesh(vertices, faces):
    return TriangleMesh(jnp.asarray(vertices, float), jnp.asarray(faces, jnp.int32))


def _check_least(name, value, least):
    if value < least:
        must = f"{name} must be at least {least}"
        raise GeometryError(message(must, f"{value}", "Pass a larger number."))
