"""Repairs of connectivity on the host: weld, clean, orient."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .._core import GeometryError, message
from ..shapes import TriangleMesh
from ._halfedges import edge_numbers, ends, fan_labels, host_faces, partners
from ._report import component_volumes, face_labels, repeats, report


class Repair(eqx.Module):
    """A mesh of exact size, and what was done to get it.

    `merged_vertices`, `removed_faces`, `removed_vertices`, `flipped_faces`,
    `filled_holes`, `added_faces`, `added_vertices`: how many. `not_orientable`: faces
    of components like the Moebius strip, that no flips orient; `holes_left`: boundary
    loops that were too long to fill.
    """

    mesh: TriangleMesh
    merged_vertices: int = 0
    removed_faces: int = 0
    removed_vertices: int = 0
    flipped_faces: int = 0
    not_orientable: int = 0
    filled_holes: int = 0
    holes_left: int = 0
    added_faces: int = 0
    added_vertices: int = 0

    def counts(self) -> dict[str, int]:
        """Everything that was done, and how often."""
        return {name: getattr(self, name) for name in _COUNTS}

    def after(self, earlier: "Repair") -> "Repair":
        """This repair, with what was done before it added."""
        both = {name: n + getattr(earlier, name) for name, n in self.counts().items()}
        # These describe the mesh as it is, not what was done.
        states = {name: getattr(self, name) for name in _STATES if name in _COUNTS}
        return Repair(self.mesh, **(both | states))

    def __str__(self) -> str:
        done = [f"{n} {k.replace('_', ' ')}" for k, n in self.counts().items() if n]
        return ", ".join(done) or "nothing to repair"


_COUNTS = tuple(Repair.__dataclass_fields__)[1:]
_STATES = ("not_orientable", "holes_left")


def weld(mesh: TriangleMesh, *, tolerance: float = 0.0) -> Repair:
    """The mesh with vertices at the same place merged into one (host).

    With `tolerance` 0 their coordinates must be equal; else all vertices that chains of
    steps of at most `tolerance` connect become one, at the place of the first. The
    first one's attributes stay. Faces that lose their area by it, and vertices without
    faces, stay too: see `clean`. Vertices that are not finite are never merged. Raises
    `GeometryError` for a negative tolerance.
    """
    if not 0 <= tolerance < np.inf:
        must = "tolerance must be a length of at least 0"
        raise GeometryError(message(must, f"{tolerance}", "Pass 0 for equal vertices."))
    mesh = mesh.trim()
    vertices = np.asarray(mesh.vertices)
    finite = np.flatnonzero(np.all(np.isfinite(vertices), axis=1))
    labels = np.arange(len(vertices))
    near = _near_groups if tolerance > 0 else _equal_groups
    group = near(vertices[finite], tolerance)
    first = np.full(group.max(initial=-1) + 1, len(vertices))
    np.minimum.at(first, group, finite)
    labels[finite] = first[group]
    keep = labels == np.arange(len(vertices))
    new_index = np.cumsum(keep) - 1
    faces = host_faces(mesh)
    exists = (faces >= 0) & (faces < len(vertices))
    faces = np.where(exists, new_index[labels[np.where(exists, faces, 0)]], keep.sum())
    welded = _rebuilt(mesh, np.flatnonzero(keep), faces)
    return Repair(welded, merged_vertices=int((~keep).sum()))


def _equal_groups(vertices, _):
    # Minus zero is zero.
    return np.unique(vertices + 0.0, axis=0, return_inverse=True)[1].reshape(-1)


def _near_groups(vertices, tolerance):
    from scipy.spatial import cKDTree

    n = len(vertices)
    pairs = cKDTree(vertices).query_pairs(tolerance, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(n, n))
    return connected_components(links, directed=False)[1]


def clean(mesh: TriangleMesh) -> Repair:
    """The mesh without faces and vertices that mean nothing (host).

    Removed are faces that name a vertex which does not exist, is not finite, or is
    named twice; faces without area in the precision of the vertices; faces with the
    same vertices as an earlier one; and then vertices without faces. Removing a face
    without area may open the surface at its sides: `weld` first, then `fill_holes`.
    """
    found = report(mesh)
    bad = np.zeros(found.num_faces, bool)
    bad[found.degenerate_faces] = True
    bad[found.duplicate_faces] = True
    bad[found.out_of_range_faces] = True
    bad |= np.any(np.isin(found.faces, found.nonfinite_vertices), axis=1)
    faces = found.faces[~bad]
    used = np.unique(faces)
    packed = _rebuilt(mesh.trim(), used, np.searchsorted(used, faces))
    lost = found.num_vertices - len(used)
    return Repair(packed, removed_faces=int(bad.sum()), removed_vertices=lost)


def orient(mesh: TriangleMesh) -> Repair:
    """The mesh with all faces wound alike, closed components outward (host).

    The winding is carried over the edges that have two faces. A closed component gets
    a positive volume, also where it is a cavity in another one; an open one keeps the
    winding of most of its faces. Components that cannot be oriented stay as they are
    and are counted in `not_orientable`.
    """
    mesh = mesh.trim()
    faces = host_faces(mesh)
    if len(faces) == 0:
        return Repair(mesh)
    flip, orientable = _windings(faces)
    turned = np.where(flip[:, None], faces[:, ::-1], faces)
    labels = face_labels(faces)
    n = labels.max() + 1
    edge = edge_numbers(faces)
    loose = (np.bincount(edge)[edge] == 1).reshape(-1, 3).any(axis=1)
    is_open = np.bincount(labels, weights=loose, minlength=n) > 0
    mostly = np.bincount(labels, weights=np.where(flip, 1, -1), minlength=n) > 0
    inward = component_volumes(np.asarray(mesh.vertices), turned, labels) < 0
    again = np.where(is_open, mostly, inward)[labels] & orientable
    flip = np.where(orientable, flip ^ again, False)
    turned = np.where(flip[:, None], faces[:, ::-1], faces)
    counts = {"flipped_faces": int(flip.sum())}
    counts["not_orientable"] = int((~orientable).sum())
    return Repair(_with_faces(mesh, turned), **counts)


def split_vertices(mesh: TriangleMesh) -> Repair:
    """The mesh with a vertex of its own for every fan of faces (host).

    Where several fans meet in one vertex (bow-ties), the surface is taken apart there:
    no vertex is non-manifold after it. Edges with more than two faces stay.
    """
    mesh = mesh.trim()
    faces = host_faces(mesh)
    corner = faces.reshape(-1)
    _, first, fan = np.unique(fan_labels(faces), return_index=True, return_inverse=True)
    fan_vertex = corner[first]
    # The fan found first keeps the vertex.
    again = repeats(fan_vertex[:, None])
    v = mesh.vertices.shape[0]
    name = np.where(again, v + np.cumsum(again) - 1, fan_vertex)
    rows = np.concatenate([np.arange(v), fan_vertex[again]])
    split = _rebuilt(mesh, rows, name[fan.reshape(-1)])
    return Repair(split, added_vertices=int(again.sum()))


def _windings(faces):
    """Which faces to flip to wind each component alike, and whether that is possible.

    Every face has two nodes, as it is and flipped; those that agree across an edge are
    linked. A component of faces falls into two mirrored ones, or into one that holds
    both nodes of every face and cannot be oriented.
    """
    f = len(faces)
    start, _ = ends(faces)
    partner = partners(faces)
    edge = edge_numbers(faces)
    here = np.flatnonzero(np.bincount(edge)[edge] == 2)
    face, other = here // 3, partner[here] // 3
    same = start[here] == start[partner[here]]
    rows = np.concatenate([face, f + face])
    columns = np.concatenate([other + f * same, other + f * ~same])
    links = coo_array((np.ones(len(rows)), (rows, columns)), shape=(2 * f, 2 * f))
    label = connected_components(links, directed=False)[1]
    return label[:f] > label[f:], label[:f] != label[f:]


def _with_faces(mesh, faces):
    return TriangleMesh(
        mesh.vertices, jnp.asarray(faces, jnp.int32), mesh.normals, mesh.attributes
    )


def _rebuilt(mesh, rows, faces):
    """The mesh of the chosen rows of the vertices."""
    take = lambda x: jnp.asarray(x)[rows]
    normals = None if mesh.normals is None else take(mesh.normals)
    attributes = {name: take(x) for name, x in mesh.attributes.items()}
    faces = jnp.asarray(faces, jnp.int32).reshape(-1, 3)
    return TriangleMesh(take(mesh.vertices), faces, normals, attributes)
