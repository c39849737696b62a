"""What is wrong with a mesh, and where."""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .._core import GeometryError, message
from ..shapes import TriangleMesh
from ._halfedges import (
    boundary_walks,
    edge_numbers,
    ends,
    fan_labels,
    host_faces,
    partners,
)

_SHOWN = 3


class MeshReport(eqx.Module):
    """The defects of a mesh, as indices into its vertices and faces (host arrays).

    - `num_vertices`, `num_faces`, `num_components` (across edges), `euler`.
    - `nonmanifold_edges` [n, 2]: edges with more than two faces.
    - `nonmanifold_vertices` [n]: vertices with more than one fan of faces.
    - `boundary_loops`: closed walks of vertices along the boundary, longest first.
    - `inconsistent_edges` [n, 2]: edges that two faces run through the same way.
    - `inward_faces` [n]: faces of closed, consistently oriented components of negative
      volume.
    - `degenerate_faces` [n]: faces that name a vertex twice, or without area in the
      precision of the vertices; `duplicate_faces` [n]: faces with the same vertices as
      an earlier one.
    - `out_of_range_faces` [n]: faces that name a vertex that does not exist.
    - `unreferenced_vertices` [n], `nonfinite_vertices` [n].

    Faces out of range take no part in the rest, and faces that name a vertex twice
    take none in the connectivity. `positions(name)` tells where the defects are.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    num_components: int
    euler: int
    nonmanifold_edges: Int[np.ndarray, "n 2"]
    nonmanifold_vertices: Int[np.ndarray, " n"]
    boundary_loops: list[Int[np.ndarray, " n"]]
    inconsistent_edges: Int[np.ndarray, "n 2"]
    inward_faces: Int[np.ndarray, " n"]
    degenerate_faces: Int[np.ndarray, " n"]
    duplicate_faces: Int[np.ndarray, " n"]
    out_of_range_faces: Int[np.ndarray, " n"]
    unreferenced_vertices: Int[np.ndarray, " n"]
    nonfinite_vertices: Int[np.ndarray, " n"]

    @property
    def num_vertices(self) -> int:
        """The number of real vertices."""
        return len(self.vertices)

    @property
    def num_faces(self) -> int:
        """The number of real faces."""
        return len(self.faces)

    def counts(self) -> dict[str, int]:
        """The name of every kind of defect, and how many there are."""
        return {name: len(getattr(self, name)) for name in _DEFECTS}

    @property
    def is_clean(self) -> bool:
        """True where there is no defect; boundary loops count as defects."""
        return not any(self.counts().values())

    def positions(self, name: str) -> Float[np.ndarray, "n 3"]:
        """Where the defects of a kind are: vertices, or middles of edges, faces, loops.

        `name` is one of those of `counts()`. Faces out of range have no position (NaN).
        """
        if name not in _DEFECTS:
            must = f"name must be one of {', '.join(_DEFECTS)}"
            raise GeometryError(message(must, repr(name), "Pass one of these."))
        indices = getattr(self, name)
        if name == "boundary_loops":
            middles = [self.vertices[loop].mean(axis=0) for loop in indices]
            return np.array(middles).reshape(-1, 3)
        if name == "out_of_range_faces":
            return np.full((len(indices), 3), np.nan)
        if name.endswith("vertices"):
            return self.vertices[indices]
        corners = indices if name.endswith("edges") else self.faces[indices]
        return self.vertices[corners].mean(axis=1)

    def __str__(self) -> str:
        head = (
            f"mesh of {self.num_vertices} vertices and {self.num_faces} faces, "
            f"{self.num_components} component(s), Euler characteristic {self.euler}"
        )
        lines = [self._line(name, n) for name, n in self.counts().items() if n]
        return "\n".join([head, *(lines or ["no defects"])])

    def _line(self, name, number):
        spots = self.positions(name)[:_SHOWN]
        spots = ["(" + ", ".join(f"{x:.6g}" for x in spot) + ")" for spot in spots]
        more = ", ..." if number > _SHOWN else ""
        words = name.replace("_", " ")
        return f"  {number} {words}, at {', '.join(spots)}{more}"


_DEFECTS = (
    "nonmanifold_edges",
    "nonmanifold_vertices",
    "boundary_loops",
    "inconsistent_edges",
    "inward_faces",
    "degenerate_faces",
    "duplicate_faces",
    "out_of_range_faces",
    "unreferenced_vertices",
    "nonfinite_vertices",
)


def report(mesh: TriangleMesh) -> MeshReport:
    """All defects of a mesh, with indices and positions (host; padding left out).

    print(report(mesh))
    """
    vertices = np.asarray(mesh.vertices)[: int(mesh.num_vertices)]
    faces = host_faces(mesh)
    exists = np.all((faces >= 0) & (faces < len(vertices)), axis=1)
    flat = np.zeros(len(faces), bool)
    flat[exists] = _flat(vertices[faces[exists]])
    distinct = exists & ~_repeats_a_vertex(faces)
    proper = np.flatnonzero(distinct)
    sound = faces[proper]
    labels = face_labels(sound)
    wrong = _inconsistent(sound)
    used = np.zeros(len(vertices), bool)
    used[faces[exists]] = True
    edge = edge_numbers(sound)
    num_edges = len(np.unique(edge))
    return MeshReport(
        vertices=vertices,
        faces=faces,
        num_components=int(labels.max(initial=-1)) + 1,
        euler=len(np.unique(sound)) - num_edges + len(sound),
        nonmanifold_edges=_edges_where(sound, np.bincount(edge)[edge] > 2),
        nonmanifold_vertices=_pinched(sound),
        boundary_loops=boundary_walks(sound),
        inconsistent_edges=_edges_where(sound, wrong),
        inward_faces=proper[_inward(vertices, sound, labels, wrong)],
        degenerate_faces=np.flatnonzero(exists & (flat | ~distinct)),
        duplicate_faces=proper[repeats(np.sort(sound, axis=1))],
        out_of_range_faces=np.flatnonzero(~exists),
        unreferenced_vertices=np.flatnonzero(~used),
        nonfinite_vertices=np.flatnonzero(~np.all(np.isfinite(vertices), axis=1)),
    )


def boundary_loops(mesh: TriangleMesh) -> list[Int[np.ndarray, " n"]]:
    """The vertices along every boundary loop, in order, longest loop first (host).

    Each loop runs the way of its faces: the surface lies to its left, seen from
    outside. Loops that touch in a vertex stay apart. Faces that name a vertex twice
    are left out; edges with an odd number of faces count as boundary.
    """
    faces = host_faces(mesh)
    return boundary_walks(faces[~_repeats_a_vertex(faces)])


def check_mesh(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh itself, if it can be worked with (host).

    Raises `GeometryError` for a mesh without faces, faces that name vertices which do
    not exist, and vertices of faces that are not finite. Other defects (`report`) are
    no errors.
    """
    found = report(mesh)
    if found.num_faces == 0:
        must = "a mesh needs at least one face"
        raise GeometryError(message(must, "0 faces", "Load or make a surface."))
    _check_none(
        found.out_of_range_faces,
        f"faces must name vertices from 0 to {found.num_vertices - 1}",
        "faces that do not",
        "Count vertices from 0, or remove these faces with `clean`.",
    )
    bad = np.isin(found.faces, found.nonfinite_vertices)
    _check_none(
        np.flatnonzero(np.any(bad, axis=1)),
        "the vertices of faces must be finite",
        "faces with NaN or infinite vertices",
        "Remove them with `clean`.",
    )
    return mesh


def _check_none(indices, must, what, fix):
    if len(indices):
        given = f"{len(indices)} {what}, the first is face {indices[0]}"
        raise GeometryError(message(must, given, fix))


def face_labels(faces: np.ndarray) -> np.ndarray:
    """The number of the component of every face, across edges (host)."""
    edge = edge_numbers(faces)
    # Edges are nodes too, so that all faces of a crowded edge hang together.
    f, e = len(faces), int(edge.max(initial=-1)) + 1
    face = np.arange(3 * f) // 3
    links = coo_array((np.ones(len(face)), (face, f + edge)), shape=(f + e, f + e))
    labels = connected_components(links, directed=False)[1][:f]
    return np.unique(labels, return_inverse=True)[1].reshape(-1)


def repeats(rows: np.ndarray) -> np.ndarray:
    """True for the rows that equal an earlier row (host)."""
    out = np.ones(len(rows), bool)
    out[np.unique(rows, axis=0, return_index=True)[1]] = False
    return out


def _repeats_a_vertex(faces):
    a, b, c = faces.T
    return (a == b) | (b == c) | (c == a)


def _flat(triangles):
    """True where the area is lost in the rounding of the corners."""
    with np.errstate(invalid="ignore", over="ignore"):
        to_next = np.roll(triangles, -1, axis=1) - triangles
        twice = np.linalg.norm(np.cross(to_next[:, 0], to_next[:, 1]), axis=-1)
        longest = np.max(np.sum(to_next**2, axis=-1), axis=-1, initial=0)
        return twice <= 4 * np.finfo(triangles.dtype).eps * longest


def _inconsistent(faces):
    """True for the half-edges that run the same way as their only partner."""
    start, _ = ends(faces)
    partner = partners(faces)
    edge = edge_numbers(faces)
    two = np.bincount(edge, minlength=1)[edge] == 2
    return two & (start == start[partner])


def _edges_where(faces, chosen):
    """The edges of the chosen half-edges, each once."""
    start, end = ends(faces)
    pairs = np.sort(np.stack([start[chosen], end[chosen]], -1), axis=-1)
    return np.unique(pairs, axis=0)


def _pinched(faces):
    """The vertices whose corners do not hang together across edges."""
    if len(faces) == 0:
        return np.zeros(0, int)
    fans = np.unique(np.stack([faces.reshape(-1), fan_labels(faces)], -1), axis=0)
    names, number = np.unique(fans[:, 0], return_counts=True)
    return names[number > 1]


def _inward(vertices, faces, labels, wrong):
    """True for the faces of closed, oriented components of negative volume."""
    if len(faces) == 0:
        return np.zeros(0, bool)
    edge = edge_numbers(faces)
    loose = np.bincount(edge)[edge] != 2
    bad = (loose | wrong).reshape(-1, 3).any(axis=1)
    n = labels.max() + 1
    spoilt = np.bincount(labels, weights=bad, minlength=n) > 0
    return (~spoilt & (component_volumes(vertices, faces, labels) < 0))[labels]


def component_volumes(vertices, faces, labels) -> np.ndarray:
    """Six times the signed volume of every component (host)."""
    triangles = vertices[faces].astype(np.float64)
    middle = np.nanmean(triangles.reshape(-1, 3), axis=0)
    a, b, c = np.moveaxis(triangles - middle, 1, 0)
    six = np.sum(a * np.cross(b, c), axis=-1)
    return np.bincount(labels, weights=six, minlength=labels.max(initial=-1) + 1)
