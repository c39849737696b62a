"""The edges of a mesh, each once, and the neighbors of its vertices."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._core import RESULTS, GeometryError, failure_where, message, prefix_sum
from ..shapes import TriangleMesh
from ._edges import edge_runs
from ._topology import proper_faces


class Edges(eqx.Module):
    """Every edge once, ordered by its smaller and then its larger vertex.

    - `vertices` [e, 2]: the smaller and the larger end; v for padding.
    - `faces` [e, 2]: the first two faces at the edge; f where there is none.
    - `num_faces` [e]: how many faces have it: 1 on the boundary, 2 inside, more where
      the mesh is not manifold, 0 for padding.
    - `of_faces` [f, 3]: the edge from corner d to corner d + 1 of each face; e for
      padding and for faces that name a vertex twice, which have no edges.
    - `required_edges`: their number, exact even if it is above the capacity e; then
      `result` is `capacity_exceeded` and the last ones are missing.
    """

    vertices: Int[Array, "e 2"]
    faces: Int[Array, "e 2"]
    num_faces: Int[Array, " e"]
    of_faces: Int[Array, "f 3"]
    required_edges: Int[Array, ""]
    result: RESULTS

    @property
    def mask(self) -> Bool[Array, " e"]:
        """True for the real edges."""
        return self.num_faces > 0

    @property
    def boundary(self) -> Bool[Array, " e"]:
        """True for the edges with one face."""
        return self.num_faces == 1


def edges(mesh: TriangleMesh, *, capacity: int | None = None) -> Edges:
    """The edges of a mesh with their faces.

    `capacity` is static; 3f, which always suffices, by default (a closed surface has
    1.5f edges). The indices are constant under differentiation.
    """
    v, f = mesh.vertices.shape[0], mesh.faces.shape[0]
    size = max(3 * f, 1) if capacity is None else capacity
    _check_capacity(size)
    proper = proper_faces(mesh)
    runs = edge_runs(jnp.where(proper[:, None], mesh.faces, v), proper, v)
    heads = runs.real & ~runs.joins
    number = prefix_sum(heads.astype(jnp.int32)) + heads - 1
    number = jnp.where(runs.real, jnp.minimum(number, size), size)
    blank = lambda fill: jnp.full(size, fill, jnp.int32)
    put = lambda fill, where, x: (
        blank(fill).at[jnp.where(where, number, size)].set(x, mode="drop")
    )
    second = runs.joins & jnp.roll(heads, 1)
    ends = [put(v, heads, runs.low), put(v, heads, runs.high)]
    sides = [put(f, heads, runs.slots // 3), put(f, second, runs.slots // 3)]
    of_faces = jnp.full(3 * f, size, jnp.int32).at[runs.slots].set(number)
    required = jnp.sum(heads, dtype=jnp.int32)
    return Edges(
        jnp.stack(ends, axis=-1),
        jnp.stack(sides, axis=-1),
        blank(0).at[number].add(1, mode="drop"),
        of_faces.reshape(f, 3),
        required,
        failure_where(required > size, RESULTS.capacity_exceeded),
    )


class VertexNeighbors(eqx.Module):
    """The vertices that share an edge with each vertex, in increasing order.

    - `vertices` [k, v]: neighbor number k of each vertex; v where there is none.
    - `edges` [k, v]: the edge to it, an index into `edge_list`; e where there is none.
    - `required_neighbors`: the largest number of them; above the capacity k `result`
      is `capacity_exceeded` and the last ones are missing.
    """

    vertices: Int[Array, "k v"]
    edges: Int[Array, "k v"]
    edge_list: Edges
    required_neighbors: Int[Array, ""]
    result: RESULTS

    @property
    def mask(self) -> Bool[Array, "k v"]:
        """True where there is a neighbor."""
        return self.vertices < self.vertices.shape[1]


def vertex_neighbors(
    mesh: TriangleMesh, *, capacity: int | None = None
) -> VertexNeighbors:
    """The table of the neighbors of all vertices, made once for many sums over them.

    `capacity` is the static number of neighbors there is room for. Without it the
    largest number is measured, which needs a concrete mesh (host); under jit pass it.
    Room is k for every vertex: a single vertex with thousands of edges costs memory.
    """
    found = edges(mesh)
    v, e = mesh.vertices.shape[0], found.mask.shape[0]
    start = jnp.concatenate([found.vertices[:, 0], found.vertices[:, 1]])
    end = jnp.concatenate([found.vertices[:, 1], found.vertices[:, 0]])
    number = jnp.tile(jnp.arange(e, dtype=jnp.int32), 2)
    start, end, number = jax.lax.sort((start, end, number), num_keys=2)
    valence = jnp.zeros(v, jnp.int32).at[start].add(1, mode="drop")
    required = jnp.max(valence, initial=0)
    size = max(int(required), 1) if capacity is None else capacity
    _check_capacity(size)
    first = prefix_sum(valence).at[start].get(mode="fill", fill_value=0)
    place = jnp.arange(2 * e, dtype=jnp.int32) - first
    table = lambda fill, x: (
        jnp.full((size, v), fill, jnp.int32).at[place, start].set(x, mode="drop")
    )
    return VertexNeighbors(
        table(v, end),
        table(e, number),
        found,
        required,
        failure_where(required > size, RESULTS.capacity_exceeded),
    )


def boundary_vertices(mesh: TriangleMesh) -> Bool[Array, " v"]:
    """True for the vertices on an edge that has one face only."""
    v = mesh.vertices.shape[0]
    found = edges(mesh)
    ends = jnp.where(found.boundary[:, None], found.vertices, v)
    return jnp.zeros(v, bool).at[ends].set(True, mode="drop")


def _check_capacity(size):
    if size < 1:
        must = "the capacity must be at least 1"
        raise GeometryError(message(must, f"{size}", "Leave it out, or pass more."))
