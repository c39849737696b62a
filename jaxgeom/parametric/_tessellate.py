"""Triangle meshes of parametric surfaces, welded at seams and poles."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core import GeometryError, message
from ..shapes import PolygonMesh, TriangleMesh
from ._abstract import AbstractSurface
from ._domain import Domain
from ._queries import normal


class Layout(eqx.Module):
    """The mesh of a rectangle with its sides glued, without its geometry (host).

    - `uv` [v, 2]: the parameters of every vertex.
    - `faces` [f, 3]: counter-clockwise in the plane of u and v.
    - `corner_uv` [f, 3, 2]: the parameters of the corners of every face. They differ
      from `uv` of their vertices beyond a seam and at a pole.
    """

    uv: np.ndarray
    faces: np.ndarray
    corner_uv: np.ndarray


def tessellate(
    surface: AbstractSurface, resolution: tuple[int, int] = (32, 32)
) -> TriangleMesh:
    """The mesh of a surface with about `resolution` cells along u and v.

    Two triangles per cell, one at poles; vertices lie on the surface, with its unit
    normals (none on a surface with one side). Sides that meet share their vertices, and
    a pole is one vertex: a torus or a sphere is watertight. Counter-clockwise faces are
    seen from the side of the normal. Cells end at the breaks of the domain. The
    distance to a smooth surface falls with the square of the resolution.

    The attribute `uv` [v, 2] holds the parameters: at a seam those of its low side, at
    a pole those at low u (or v). To draw a texture across a seam use `corner_uv` of
    `layout(surface.domain(), resolution)`, whose faces are the same.

    Static sizes; differentiable in the parameters of the surface. Raises
    `GeometryError` for too few cells.
    """
    plan = layout(surface.domain(), resolution)
    return mesh_of(surface, plan.uv, plan.faces)


def tessellate_quads(
    surface: AbstractSurface, resolution: tuple[int, int] = (32, 32)
) -> PolygonMesh:
    """The cells of `tessellate` as quads, and as triangles at poles (host).

    Vertices, attribute and errors are those of `tessellate`; a mesh of polygons has no
    normals of its own.
    """
    uv, _, vertex, ids = _welded(surface.domain(), resolution)
    cells = vertex[_cells(ids)]
    # A pole is one corner: the one before it is left out.
    again = cells == np.roll(cells, -1, axis=1)
    corners = 4 - again.sum(axis=1)
    groups = [
        cells[corners == k][~again[corners == k]].reshape(-1, k).astype(np.int32)
        for k in (3, 4)
    ]
    uv = jnp.asarray(uv, float)
    return PolygonMesh(jax.vmap(surface)(uv), [g for g in groups if len(g)], {"uv": uv})


def layout(domain: Domain, resolution: tuple[int, int]) -> Layout:
    """How `tessellate` glues the cells of a domain (host).

    Raises `GeometryError` for fewer than one cell, than three around a periodic
    parameter or than two between two poles.
    """
    uv, nodes, vertex, ids = _welded(domain, resolution)
    a, b, c, d = _cells(ids).T
    corners = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    faces = vertex[corners]
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return Layout(uv, faces[whole].astype(np.int32), nodes[corners[whole]])


def _welded(domain, resolution):
    """The parameters of the vertices and of all nodes, the vertex of each node, and the
    numbers [u, v] of the nodes."""
    for name, along, cells in zip("uv", (domain.u, domain.v), resolution, strict=True):
        _check_cells(name, along, cells)
    u, v = domain.u.nodes(resolution[0]), domain.v.nodes(resolution[1])
    ids = np.arange(len(u) * len(v)).reshape(len(u), len(v))
    kept, vertex = np.unique(_glued(ids, domain), return_inverse=True)
    nodes = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
    return nodes[kept], nodes, vertex.reshape(-1), ids


def mesh_of(surface: AbstractSurface, uv: np.ndarray, faces: np.ndarray):
    """The mesh with vertices at the parameters uv [v, 2]."""
    # Literals of the host: the parameters take the floating type of the session.
    uv = jnp.asarray(uv, float)
    domain = surface.domain()
    one_sided = domain.u.twisted or domain.v.twisted
    normals = None if one_sided else jax.vmap(lambda x: normal(surface, x))(uv)
    vertices = jax.vmap(surface)(uv)
    return TriangleMesh(vertices, jnp.asarray(faces), normals, {"uv": uv})


def _cells(ids):
    """The corners of every cell [c, 4], counter-clockwise."""
    corners = ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]
    return np.stack([x.ravel() for x in corners], axis=1)


def _glued(ids, domain):
    """For every node the first node at the same place."""
    pairs = [*_seam(ids, domain.u), *_seam(ids.T, domain.v)]
    pairs += [*_collapsed(ids, domain.u), *_collapsed(ids.T, domain.v)]
    labels = ids.ravel().copy()
    if not pairs:
        return labels
    a, b = (np.concatenate(side) for side in zip(*pairs, strict=True))
    # Two seams that cross need a second round, a twisted one a third.
    while True:
        least = np.minimum(labels[a], labels[b])
        if (least == labels[a]).all() and (least == labels[b]).all():
            return labels
        np.minimum.at(labels, a, least)
        np.minimum.at(labels, b, least)


def _seam(rows, along):
    """The nodes at the high end of a periodic parameter, with those at the low end."""
    if not along.periodic:
        return []
    first = rows[0, ::-1] if along.twisted else rows[0]
    return [(first, rows[-1])]


def _collapsed(rows, along):
    ends = [rows[end] for end, pole in zip((0, -1), along.poles, strict=True) if pole]
    return [(np.broadcast_to(end[:1], end.shape), end) for end in ends]


def _check_cells(name, along, cells):
    least = 3 if along.periodic else 2 if all(along.poles) else 1
    if cells < least:
        must = f"the resolution along {name} must be at least {least}"
        raise GeometryError(message(must, f"{cells}", "Pass more cells."))
