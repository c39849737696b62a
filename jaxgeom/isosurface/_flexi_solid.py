"""The inside of a FlexiCubes mesh as tetrahedra.

Each cell has a place of its own for every set of inside corners that its edges connect
(a *piece*): the vertex of its patch, or where it has none, or several, one amid them.

- A cut edge with its inside end a: the triangles of its quad, each with a.
- An edge a b with both ends inside, and a face of the grid along it: a, b and the
  places of the two cells across the face.
- Where a cell has a place other than the vertex p of the patch on a cut edge of a: what
  lies between them, for each face along that edge the pyramid of a over the two places
  and the two vertices, unless a's other edge in the face is cut by the same patches.

Each triangle that is not of the surface bounds two tetrahedra, from its two sides: the
tetrahedra fill what the surface encloses.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..shapes import Grid, TetrahedralMesh
from ._cube import edges, faces
from ._dual import find_dual
from ._extract import extract
from ._extraction import Capacity
from ._flexicubes import (
    AbstractQuadSplit,
    Diagonals,
    FlexiCubes,
    FlexiWeights,
    flexicubes,
    moved_nodes,
)
from ._marching_cubes import as_float
from ._patch_tables import NO_FACE, edge_code, edge_number, patch_tables

_DIAGONALS = Diagonals()
_CORNERS = np.array([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)])


class FlexiSolid(eqx.Module):
    """Tetrahedra inside of a FlexiCubes mesh, and how their vertices are found.

    - `mesh`: the tetrahedra. Its first vertices are those of the surface, then come the
      nodes of the grid that it uses, then the places of cells.
    - `nodes`: the flat indices of these nodes.
    - `around`: [m, 8] the vertices whose mean the place of a cell is, -1 in padding.
    """

    mesh: TetrahedralMesh
    nodes: Int[np.ndarray, " k"]
    around: Int[np.ndarray, "m 8"]
    capacity: Capacity
    split: AbstractQuadSplit
    num_surface: int = eqx.field(static=True)

    def moved(
        self,
        values: Float[Array, "x y z"],
        grid: Grid,
        weights: FlexiWeights,
        level: Float[Array, ""] | float = 0.0,
    ) -> TetrahedralMesh:
        """The same tetrahedra where other values and weights put their vertices.

        Pure and differentiable; of use as long as the same nodes are inside.
        """
        sizes = {"capacity": self.capacity, "split": self.split}
        out = flexicubes(values, grid, weights, level, **sizes)
        surface = out.extraction.mesh.vertices[: self.num_surface]
        corners = moved_nodes(jnp.asarray(self.nodes), grid, weights.offsets)
        vertices = _joined(surface, corners, jnp.asarray(self.around), jnp)
        return TetrahedralMesh(vertices, self.mesh.tetrahedra)


def flexicubes_solid(
    values: Float[Array, "x y z"],
    grid: Grid,
    weights: FlexiWeights | None = None,
    level: Float[Array, ""] | float = 0.0,
    *,
    split: AbstractQuadSplit = _DIAGONALS,
) -> FlexiSolid:
    """The inside of the mesh of `flexicubes`, filled with tetrahedra (host).

    Their boundary is that mesh, and their signed volumes add up to what it encloses,
    whatever the weights. Single ones may be turned over where weights are extreme or a
    quad is far from plane. A surface that leaves the grid leaves its last half cell
    open, and so do they. Empty where the values do not change their sign.

    **Arguments:** as `flexicubes`; without weights, all are zero. Sizes are exact.
    """
    values, level = as_float(values, level)
    if weights is None:
        weights = FlexiWeights.zeros(grid.shape, values.dtype)
    out = extract(values, grid, level, method=FlexiCubes(weights, split))
    needed = out.required_vertices, out.required_faces, out.required_cells
    capacity, surface = Capacity.holding(*map(int, needed)), out.mesh
    dual = jax.device_get(_dual(values, level, capacity))
    inside = np.asarray((values < level) & jnp.isfinite(values))
    cells = _Cells(inside, dual.patches, len(surface.vertices))
    found = [_behind_quads(np.asarray(surface.faces), dual, inside.shape, split, cells)]
    for axis in range(3):
        found += _along_faces(cells, axis)
    tetrahedra = np.concatenate(found)
    # Where a place is the vertex of the patch, nothing lies between them.
    tetrahedra = tetrahedra[_distinct(tetrahedra)]
    nodes, tetrahedra, around = _numbered(tetrahedra, cells)
    corners = np.asarray(_all_nodes(grid, weights))[nodes]
    vertices = _joined(np.asarray(surface.vertices), corners, around, np)
    mesh = TetrahedralMesh(vertices, tetrahedra)
    return FlexiSolid(mesh, nodes, around, capacity, split, len(surface.vertices))


@eqx.filter_jit
def _dual(values, level, capacity):
    return find_dual(values, level, capacity, None)


@eqx.filter_jit
def _all_nodes(grid, weights):
    number = jnp.arange(weights.offsets.size // 3)
    return moved_nodes(number, grid, weights.offsets)


def _joined(surface, corners, around, xp):
    """The vertices of the surface, the nodes, and the means of some of them."""
    known = xp.concatenate([surface, corners])
    real = around >= 0
    near = xp.where(real[..., None], known[xp.where(real, around, 0)], 0)
    number = xp.maximum(xp.sum(real, axis=1), 1)[:, None].astype(known.dtype)
    return xp.concatenate([known, xp.sum(near, axis=1) / number])


class _Cells:
    """What is asked of the cells: numbers of vertices as they are before counting.

    Surface vertices keep their numbers; a node n is `node_base` + n; the place of the
    piece of corner c of a cell is its patch's vertex, or `place_base` + 8 cell + c.
    """

    def __init__(self, inside, patches, num_surface):
        self.inside, self.shape = inside, inside.shape
        self.node_base = num_surface
        self.place_base = num_surface + inside.size
        x, y, z = (n - 1 for n in inside.shape)
        cut = lambda c: inside[c[0] : c[0] + x, c[1] : c[1] + y, c[2] : c[2] + z]
        self.corners = np.stack([cut(c) for c in _CORNERS], axis=-1)
        self.vertex = self._vertices(patches, num_surface)
        self.flipped = self._flipped()
        self.place, self.extremes = self._places()

    def _vertices(self, patches, num_surface):
        """The surface vertex on every edge [x, y, z, 12] of the cells; -1 for none."""
        x, y, z = (n - 1 for n in self.shape)
        node, code = patches.node[:num_surface], patches.code[:, :num_surface]
        held = patches.held[:, :num_surface]
        table = np.zeros(32, int)
        for edge in edges():
            table[edge_code(edge)] = edge_number(edge)
        place = np.unravel_index(node, self.shape)
        cell = np.ravel_multi_index(place, (x, y, z), mode="clip")
        out = np.full((x * y * z, 12), -1, np.int64)
        rows = np.broadcast_to(cell, held.shape)[held]
        vertex = np.broadcast_to(np.arange(num_surface), held.shape)[held]
        out[rows, table[code[held]]] = vertex
        return out.reshape(x, y, z, 12)

    def _flipped(self):
        """The flipped face of every cell, or `NO_FACE`."""
        case = self.corners @ (1 << np.arange(8))
        bridged = patch_tables().bridged[case]
        out = np.full(case.shape, NO_FACE)
        for axis in range(3):
            low, high = _pair(case.shape, axis)
            both = (bridged[low] == 2 * axis + 1) & (bridged[high] == 2 * axis)
            out[low] = np.where(both, 2 * axis + 1, out[low])
            out[high] = np.where(both, 2 * axis, out[high])
        return out

    def _places(self):
        """The place of the piece of every inside corner [x, y, z, 8], and the lowest
        and highest patch vertex of each piece."""
        label = np.broadcast_to(np.arange(8), self.corners.shape).copy()
        both = lambda a, b: self.corners[..., a] & self.corners[..., b]
        joined = [(a, b, both(a, b)) for a, b in edges()]
        for f, ring in enumerate(faces()):
            across = (ring[::2], ring[1::2])
            joined += [(*ends, both(*ends) & (self.flipped == f)) for ends in across]
        # No two of eight corners are further apart than four sweeps of all edges reach.
        for _ in range(4):
            for a, b, same in joined:
                lower = np.minimum(label[..., a], label[..., b])
                label[..., a] = np.where(same, lower, label[..., a])
                label[..., b] = np.where(same, lower, label[..., b])
        most = np.full(self.corners.shape, -1, np.int64)
        least = np.full(self.corners.shape, np.iinfo(np.int64).max)
        for a, b in edges():
            vertex = self.vertex[..., edge_number((a, b))]
            piece = np.where(self.corners[..., a], label[..., a], label[..., b])
            for extreme, choose in ((most, np.maximum), (least, np.minimum)):
                old = np.take_along_axis(extreme, piece[..., None], -1)[..., 0]
                new = np.where(vertex >= 0, choose(old, vertex), old)
                np.put_along_axis(extreme, piece[..., None], new[..., None], -1)
        cell = np.arange(self.corners[..., 0].size).reshape(self.corners.shape[:3])
        own = self.place_base + 8 * cell[..., None] + label
        most, least = (np.take_along_axis(x, label, -1) for x in (most, least))
        return np.where(most == least, most, own), (least, most)


def _pair(shape, axis):
    """Slices of all cells but the last, and but the first, along an axis."""
    low, high = [slice(None)] * len(shape), [slice(None)] * len(shape)
    low[axis], high[axis] = slice(0, shape[axis] - 1), slice(1, None)
    return tuple(low), tuple(high)


def _behind_quads(triangles, dual, shape, split, cells):
    """Every triangle of the surface with the inside end of its cut edge."""
    held = np.asarray(dual.held)
    node, axis = np.asarray(dual.edges.node)[held], np.asarray(dual.edges.axis)[held]
    strides = np.array([shape[1] * shape[2], shape[2], 1])
    apex = node + np.where(np.asarray(dual.inside)[held], 0, strides[axis])
    apex = cells.node_base + np.repeat(apex, split.faces_per_quad)
    return np.concatenate([triangles[:, [0, 2, 1]], apex[:, None]], axis=1)


def _along_faces(cells, axis):
    """The tetrahedra across the faces of the grid with a normal."""
    low, high = _pair(cells.corners.shape[:3], axis)
    u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
    # Around the face, counter-clockwise seen from its upper side.
    ring = [0, u, u + v, v]
    before, after = [c + (1 << axis) for c in ring], ring
    inside = [cells.corners[high][..., c] for c in after]
    first = [cells.place[low][..., c] for c in before]
    second = [cells.place[high][..., c] for c in after]
    flat = np.arange(cells.inside.size).reshape(cells.shape)
    x, y, z = cells.corners.shape[:3]
    nodes = [
        cells.node_base + flat[c[0] : c[0] + x, c[1] : c[1] + y, c[2] : c[2] + z][high]
        for c in _CORNERS[after]
    ]
    flipped = cells.flipped[high] == 2 * axis
    on_edge = lambda cell, ends, i, j: cell[
        ..., edge_number(tuple(sorted((ends[i], ends[j]))))
    ]
    out = []
    for i in range(4):
        j = (i + 1) % 4
        both = inside[i] & inside[j]
        out.append(_rows(both, nodes[i], nodes[j], first[i], second[i]))
        for here, there, other in ((i, j, (i - 1) % 4), (j, i, (j + 1) % 4)):
            # A cut edge, with its inside end `here`; the face's next edge at `here`.
            use = inside[here] & ~inside[there] & (inside[other] | flipped)
            p = on_edge(cells.vertex[low], before, i, j)
            q = on_edge(cells.vertex[high], after, i, j)
            a, c, d = nodes[here], first[here], second[here]
            # The base is cut from c to q, also where the other end of it is filled.
            for tip, foot in ((d, q), (q, p)):
                ends = (c, tip) if here == i else (tip, c)
                out.append(_rows(use, a, *ends, foot))
    return out


def _rows(use, *corners):
    return np.stack([x[use] for x in corners], axis=1)


def _distinct(rows):
    ordered = np.sort(rows, axis=1)
    return np.all(ordered[:, 1:] != ordered[:, :-1], axis=1)


def _numbered(tetrahedra, cells):
    """The nodes in use, the tetrahedra by final numbers, and what places lie amid."""
    used = np.unique(tetrahedra)
    nodes = used[(used >= cells.node_base) & (used < cells.place_base)]
    places = used[used >= cells.place_base]
    # Places of whole cells lie amid their corners, which must be there.
    cell, corner = np.divmod(places - cells.place_base, 8)
    least, most = (x.reshape(-1, 8)[cell, corner] for x in cells.extremes)
    whole = most < 0
    at = np.stack(np.unravel_index(cell, cells.corners.shape[:3]), axis=-1)
    rows = np.ravel_multi_index(
        tuple(np.moveaxis(at[:, None] + _CORNERS, -1, 0)), cells.shape
    )
    rows = cells.node_base + rows
    nodes = np.union1d(nodes, rows[whole])
    ends = np.where(np.arange(8) == 0, least[:, None], most[:, None])
    ends = np.where(np.arange(8) < 2, ends, -1)
    around = np.where(whole[:, None], rows, ends)
    number = lambda x: np.where(
        x < cells.node_base,
        x,
        np.where(
            x < cells.place_base,
            cells.node_base + np.searchsorted(nodes, x),
            cells.node_base + len(nodes) + np.searchsorted(places, x),
        ),
    )
    flat = (nodes - cells.node_base).astype(np.int32)
    around = np.where(around < 0, -1, number(around))
    return flat, number(tetrahedra).astype(np.int32), around.astype(np.int32)
