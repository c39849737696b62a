"""The connectivity of a mesh on the host: corners, sides, edges, and its refinement.

Everything is numpy. A corner h belongs to one face and names one vertex; its side runs
to the next corner of the face. Children are numbered by arithmetic from their parents,
so that edges are sorted for the coarsest mesh only.
"""

import equinox as eqx
import numpy as np

from .._core import GeometryError, message
from ..shapes import PolygonMesh, TriangleMesh


class Net(eqx.Module):
    """Who meets whom, and how sharply.

    - `num_vertices`; `sizes` [f]: the corners of every face.
    - `corners` [h]: the vertex of each corner, face after face; `sides` [h]: the edge
      from it to the next.
    - `ends` [2, e]: the vertices of each edge; `border` [e]: True for edges of one
      face.
    - `sharpness` [e]: 0 for smooth, infinite for creases that stay and for the border;
      `pins` [v]: the sharpness of vertices.
    """

    num_vertices: int
    sizes: np.ndarray
    corners: np.ndarray
    sides: np.ndarray
    ends: np.ndarray
    border: np.ndarray
    sharpness: np.ndarray
    pins: np.ndarray

    @property
    def face(self):
        """The face of every corner [h]."""
        return np.repeat(np.arange(self.sizes.size, dtype=np.int32), self.sizes)

    @property
    def following(self):
        """The next corner of the same face [h]."""
        return _turned(self.sizes, 1)

    @property
    def preceding(self):
        """The corner before it in the same face [h]."""
        return _turned(self.sizes, -1)

    @property
    def valence(self):
        """The number of edges at every vertex [v]."""
        return np.bincount(self.ends.ravel(), minlength=self.num_vertices)

    @property
    def is_uniform(self) -> bool:
        """All faces have the same number of corners."""
        return bool(np.all(self.sizes == self.sizes[0]))


def net_of(mesh: TriangleMesh | PolygonMesh) -> Net:
    """The connectivity of a mesh without padding; its border is infinitely sharp.

    Raises `GeometryError` for a mesh without faces, for indices out of range, for a
    face that names a vertex twice and for an edge of more than two faces.
    """
    groups = [np.asarray(g, np.int32) for g in _groups(mesh) if g.shape[0]]
    v = mesh.vertices.shape[0]
    if not groups:
        fix = "Subdivide a mesh that has some."
        raise GeometryError(message("the mesh must have faces", "none", fix))
    sizes = np.concatenate([np.full(len(g), g.shape[1], np.int32) for g in groups])
    corners = np.concatenate([g.ravel() for g in groups])
    _check_indices(corners, v)
    end = corners[_turned(sizes, 1)]
    key = np.minimum(corners, end) * np.int64(v) + np.maximum(corners, end)
    unique, sides, count = np.unique(key, return_inverse=True, return_counts=True)
    ends = np.stack([unique // v, unique % v]).astype(np.int32)
    _check_faces(sizes, corners)
    _check_edges(ends, count)
    border = count == 1
    sharpness = np.where(border, np.inf, 0.0)
    sides = sides.reshape(-1).astype(np.int32)
    return Net(v, sizes, corners, sides, ends, border, sharpness, np.zeros(v))


def faces_of(net: Net) -> tuple[np.ndarray, ...]:
    """The faces as arrays [f, k], one for each k, in the order of the mesh."""
    return grouped(net.corners, net.sizes)


def grouped(values, sizes) -> tuple[np.ndarray, ...]:
    """One value for each corner as arrays [f, k], in the order of first appearance."""
    kinds, first = np.unique(sizes, return_index=True)
    at = np.repeat(sizes, sizes)
    return tuple(values[at == k].reshape(-1, k) for k in kinds[np.argsort(first)])


def check_room(net: Net, levels: int) -> None:
    """Raise `GeometryError` where int32 cannot number the corners `levels` later."""
    corners = net.corners.size * 4**levels
    if corners > np.iinfo(np.int32).max:
        must = f"a mesh must have less than 2^31 corners after {levels} levels"
        fix = "Use fewer levels; for creases that stay use a sharpness of numpy.inf."
        raise GeometryError(message(must, f"{corners}", fix))


def split_triangles(net: Net) -> Net:
    """Every triangle in four: new vertices v + edge on the edges."""
    v, e, h = net.num_vertices, net.ends.shape[1], net.corners.size
    triple = lambda x: x.reshape(-1, 3)
    corner, side = triple(net.corners), triple(net.sides)
    before = np.roll(side, 1, axis=1)
    inner = triple(2 * e + np.arange(h, dtype=np.int32))
    # Corner d gives (corner, middle of its side, middle of the side before).
    tips = np.stack([corner, v + side, v + before], -1)
    tip_sides = np.stack(
        [_half(net, side, corner), inner, _half(net, before, corner)], -1
    )
    middle, middle_sides = v + side, np.roll(inner, -1, axis=1)
    corners = np.concatenate([tips, middle[:, None]], 1).ravel()
    sides = np.concatenate([tip_sides, middle_sides[:, None]], 1).ravel()
    spokes = np.stack([v + before, v + side]).reshape(2, -1)
    return _child(net, v + e, np.full(h // 3 * 4, 3, np.int32), corners, sides, spokes)


def split_polygons(net: Net) -> Net:
    """Every corner as one quadrilateral: v + edge on edges, v + e + face inside."""
    v, e, h = net.num_vertices, net.ends.shape[1], net.corners.size
    center = v + e + net.face
    before = net.sides[net.preceding]
    spoke = 2 * e + np.arange(h, dtype=np.int32)
    corners = np.stack([net.corners, v + net.sides, center, v + before], -1)
    halves = _half(net, net.sides, net.corners), _half(net, before, net.corners)
    sides = np.stack([halves[0], spoke, spoke[net.preceding], halves[1]], -1)
    spokes = np.stack([v + net.sides, center])
    sizes = np.full(h, 4, np.int32)
    count = v + e + net.sizes.size
    return _child(net, count, sizes, corners.ravel(), sides.ravel(), spokes)


def _child(net, num_vertices, sizes, corners, sides, spokes) -> Net:
    """The finer net, still without sharpness inside; `spokes` are its inner edges."""
    v, e = net.num_vertices, net.ends.shape[1]
    middle = v + np.arange(e, dtype=np.int32)
    halves = np.concatenate([net.ends, np.stack([middle, middle])], axis=0)
    ends = np.concatenate([halves[[0, 2]], halves[[1, 3]], spokes], axis=1)
    inner = np.zeros(spokes.shape[1], bool)
    border = np.concatenate([net.border, net.border, inner])
    sharpness = np.where(border, np.inf, 0.0)
    ends = ends.astype(np.int32)
    pins = np.zeros(num_vertices)
    return Net(num_vertices, sizes, corners, sides, ends, border, sharpness, pins)


def _half(net, edge, vertex):
    """The number of the half of an edge at one of its ends."""
    return edge + np.where(net.ends[0][edge] == vertex, 0, net.ends.shape[1]).astype(
        np.int32
    )


def _turned(sizes, step):
    """The corner `step` further along the face of each corner."""
    total = int(sizes.sum())
    h = np.arange(total, dtype=np.int32)
    if np.all(sizes == sizes[0]):
        return np.roll(h.reshape(-1, sizes[0]), -step, axis=1).ravel()
    first = np.repeat(np.cumsum(sizes, dtype=np.int32) - sizes, sizes)
    return first + (h - first + step) % np.repeat(sizes, sizes)


def _groups(mesh):
    return mesh.faces if isinstance(mesh, PolygonMesh) else (mesh.faces,)


def _check_indices(corners, v):
    low, high = int(corners.min()), int(corners.max())
    if low < 0 or high >= v:
        must = f"faces must name vertices 0 ... {v - 1}"
        fix = "Remove the faces that name other vertices, or pass all vertices."
        raise GeometryError(message(must, f"indices from {low} to {high}", fix))


def _check_faces(sizes, corners):
    """No face may name a vertex twice."""
    face = np.repeat(np.arange(sizes.size), sizes)
    key = np.sort(face * (np.int64(corners.max()) + 1) + corners)
    twice = key[1:] == key[:-1]
    if np.any(twice):
        where = int(key[1:][twice][0] // (np.int64(corners.max()) + 1))
        must = "every face must name each of its vertices once"
        fix = "Remove degenerate faces first."
        raise GeometryError(message(must, f"face {where} names one twice", fix))


def _check_edges(ends, count):
    crowded = np.flatnonzero(count > 2)
    if crowded.size:
        first = crowded[0]
        must = "every edge must belong to one or two faces"
        a, b = ends[:, first].tolist()
        given = f"{crowded.size} with more, first ({a}, {b}) with {count[first]} faces"
        fix = "Split the surface there, or keep one of its sheets."
        raise GeometryError(message(must, given, fix))
