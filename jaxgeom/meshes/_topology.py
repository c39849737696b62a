"""What kind of surface a mesh is, from its faces alone."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import components, prefix_sum
from ..shapes import TriangleMesh
from ._edges import EdgeRuns, edge_runs
from ._geometry import corners, doubled


class Topology(eqx.Module):
    """The connectivity of a mesh. Faces that name a vertex twice do not take part.

    - `euler`: vertices that have faces - edges + faces.
    - `num_components`: sets of faces connected across edges.
    - `is_closed`: there are faces, and every edge has at least two.
    - `is_manifold`: every edge has at most two faces, and the faces around every vertex
      are one fan (no bow-ties).
    - `is_oriented`: every edge with several faces is run through equally often in both
      directions.
    - `boundary_edges`, `boundary_loops`: edges with one face, and the connected sets of
      them.
    - `nonmanifold_edges`, `nonmanifold_vertices`: edges with more than two faces, and
      vertices with more than one fan of faces.
    - `duplicate_faces`: faces with the same three vertices as an earlier one.
    - `degenerate_faces`: faces that name a vertex twice or have no area in the
      precision of the vertices.
    - `genus`: the number of handles of all components together,
      (2 num_components - euler - boundary_loops) / 2; zero where it is not defined,
      that is where not both `is_manifold` and `is_oriented`.
    """

    euler: Int[Array, ""]
    num_components: Int[Array, ""]
    is_closed: Bool[Array, ""]
    is_manifold: Bool[Array, ""]
    is_oriented: Bool[Array, ""]
    boundary_edges: Int[Array, ""]
    boundary_loops: Int[Array, ""]
    nonmanifold_edges: Int[Array, ""]
    nonmanifold_vertices: Int[Array, ""]
    duplicate_faces: Int[Array, ""]
    degenerate_faces: Int[Array, ""]
    genus: Int[Array, ""]

    @property
    def is_watertight(self) -> Bool[Array, ""]:
        """Closed, manifold and oriented: the mesh bounds a solid."""
        return self.is_closed & self.is_manifold & self.is_oriented


class Components(eqx.Module):
    """The connected sets of faces, face to face across edges.

    `labels` [f]: the first face of the component; f for padding. A face that names a
    vertex twice is a component of its own. `num_components` counts them all.
    """

    labels: Int[Array, " f"]
    num_components: Int[Array, ""]


def topology(mesh: TriangleMesh) -> Topology:
    """Euler characteristic, components, defects and genus of a mesh.

    Half-edges are sorted by their edge (a pair of int32 keys: no overflow at any
    size), then counted; components and fans are labelled by hooking and halving. All
    of it is exact, and constant under differentiation.
    """
    v = mesh.vertices.shape[0]
    proper = proper_faces(mesh)
    faces = jnp.where(proper[:, None], mesh.faces, v)
    runs = edge_runs(faces, proper, v)
    size, balance = _run_counts(runs, faces)
    count = lambda condition: jnp.sum(condition, dtype=jnp.int32)
    num_faces = count(proper)
    used = jnp.zeros(v, bool).at[faces].set(True, mode="drop")
    euler = count(used) - count(size > 0) + num_faces
    labels = _face_labels(runs, faces.shape[0])
    pieces = count((labels == jnp.arange(faces.shape[0])) & proper)
    loops = _boundary_loops(runs, size, v)
    fans = fans_per_vertex(runs, faces, v)
    boundary, crowded, pinched = count(size == 1), count(size > 2), count(fans > 1)
    is_manifold = (crowded == 0) & (pinched == 0)
    is_oriented = ~jnp.any((size > 1) & (balance != 0))
    genus = (2 * pieces - euler - loops) // 2
    return Topology(
        euler=euler,
        num_components=pieces,
        is_closed=(boundary == 0) & (num_faces > 0),
        is_manifold=is_manifold,
        is_oriented=is_oriented,
        boundary_edges=boundary,
        boundary_loops=loops,
        nonmanifold_edges=crowded,
        nonmanifold_vertices=pinched,
        duplicate_faces=count(repeated_faces(runs)),
        degenerate_faces=count(mesh.face_mask & (~proper | flat_faces(mesh))),
        genus=jnp.where(is_manifold & is_oriented, genus, 0),
    )


def face_components(mesh: TriangleMesh) -> Components:
    """The connected component of every face, across edges (not single vertices)."""
    v, f = mesh.vertices.shape[0], mesh.faces.shape[0]
    proper = proper_faces(mesh)
    faces = jnp.where(proper[:, None], mesh.faces, v)
    labels = _face_labels(edge_runs(faces, proper, v), f)
    first = (labels == jnp.arange(f)) & mesh.face_mask
    labels = jnp.where(mesh.face_mask, labels, f)
    return Components(labels, jnp.sum(first, dtype=jnp.int32))


def proper_faces(mesh):
    """True for the real faces that name three different vertices."""
    a, b, c = (jnp.asarray(mesh.faces)[:, d] for d in range(3))
    return mesh.face_mask & (a != b) & (b != c) & (c != a)


def flat_faces(mesh) -> Bool[Array, " f"]:
    """True where the area is lost in the rounding of the corners."""
    triangles = corners(mesh)
    sides = triangles - jnp.roll(triangles, 1, axis=1)
    longest = jnp.max(jnp.sum(sides**2, axis=-1), axis=-1)
    twice: Float[Array, " f"] = jnp.sum(doubled(triangles) ** 2, axis=-1)
    rounding = 4 * jnp.finfo(triangles.dtype).eps
    return twice <= (rounding * longest) ** 2


def _run_counts(runs: EdgeRuns, faces):
    """Per half-edge that begins a run: the faces of its edge, forward minus backward.

    Zero for all other half-edges.
    """
    e = runs.slots.shape[0]
    forward = faces.reshape(-1)[runs.slots] == runs.low
    heads = runs.real & ~runs.joins
    number = prefix_sum(heads.astype(jnp.int32)) + heads - 1
    run = jnp.where(runs.real, number, e)
    total = lambda x: jnp.zeros(e, jnp.int32).at[run].add(x, mode="drop")
    at_heads = lambda x: jnp.where(heads, x[number], 0)
    signs = jnp.where(forward, 1, -1).astype(jnp.int32)
    return at_heads(total(1)), at_heads(total(signs))


def _before(x):
    """x[i - 1]; anything at 0."""
    return jnp.roll(x, 1)


def _face_labels(runs, f):
    face = runs.slots // 3
    return components(f, face, jnp.where(runs.joins, _before(face), f))


def _boundary_loops(runs, size, v):
    boundary = size == 1
    low = jnp.where(boundary, runs.low, v)
    labels = components(v, low, runs.high)
    reached = jnp.zeros(v, bool).at[labels.at[low].get(mode="fill", fill_value=v)]
    return jnp.sum(reached.set(True, mode="drop"), dtype=jnp.int32)


def fans_per_vertex(runs, faces, v):
    """How many separate fans of faces each vertex has."""
    e = runs.slots.shape[0]
    start = runs.slots
    end = start - start % 3 + (start + 1) % 3
    forward = faces.reshape(-1)[start] == runs.low
    at_low, at_high = jnp.where(forward, start, end), jnp.where(forward, end, start)
    other = lambda node: jnp.where(runs.joins, _before(node), e)
    links_a = jnp.concatenate([at_low, at_high])
    links_b = jnp.concatenate([other(at_low), other(at_high)])
    labels = components(e, links_a, links_b)
    first = labels == jnp.arange(e)
    vertex = jnp.where(first, faces.reshape(-1), v)
    return jnp.zeros(v, jnp.int32).at[vertex].add(1, mode="drop")


def repeated_faces(runs):
    """True where a half-edge repeats the face before it in its run.

    Each face is looked at along the edge of its two smaller vertices only.
    """
    same = runs.joins & (runs.apex == _before(runs.apex))
    return same & (runs.apex > runs.high)
