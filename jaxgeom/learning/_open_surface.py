"""A mesh of an unsigned field: the surface may be open, and has no inside.

No sign tells which edges of the grid are cut. What tells is that the distance falls
from both ends towards the surface: an edge is cut where the gradients at its ends are
opposed and point away from each other, and where the two distances add up to no more
than a plane between them allows. Every cut edge gets
a quad that joins the four cells around it, every cell one vertex (as in dual
contouring), so that no consistent sign is needed and borders stay open.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core import RESULTS, bucket, failure_where, first_failure, safe_normalize
from ..shapes import Grid, TriangleMesh
from ._unsigned import pull

# A plane that cuts an edge is as far from both ends together as they are apart along
# its normal; this share of an edge is allowed for curvature and errors of the network.
_SLACK = 0.25


class OpenSurface(eqx.Module):
    """A mesh of an open surface with the sizes that it needed.

    Faces are not oriented: see `meshes.orient`. `result`: `no_surface`, or
    `capacity_exceeded` (then the mesh is a valid prefix).
    """

    mesh: TriangleMesh
    result: RESULTS
    required_vertices: Int[Array, ""]
    required_faces: Int[Array, ""]


class _Samples(eqx.Module):
    values: Float[Array, "x y z"]
    slopes: Float[Array, "x y z 3"]


def open_surface(field: Callable, grid: Grid, *, num_steps: int = 3) -> OpenSurface:
    """The mesh of the zero set of an unsigned field (host: measures, sizes, trims).

    **Arguments:**

    - `field`: point [3] -> distance >= 0, such as `Unsigned`.
    - `grid`: cells well below the distance between two sheets of the surface.
    - `num_steps`: how often vertices are pulled towards the surface along grad f.

    **Statuses:** `no_surface`.

    Sources: the crossings, after B. Guillard et al., MeshUDF, 2022; the quads, after Z.
    Chen et al., Neural dual contouring, 2022 (unsigned variant).
    """
    samples = _sampled(field, grid)
    cut = _cuts(samples, grid)
    vertices, quads = (int(n) for n in jax.device_get(_needs(cut)))
    sizes = bucket(max(vertices, 1)), bucket(max(quads, 1))
    found = _mesh(field, grid, samples, cut, sizes, num_steps)
    return eqx.tree_at(lambda s: s.mesh, found, found.mesh.trim())


def open_surface_jit(
    field: Callable,
    grid: Grid,
    *,
    capacity: tuple[int, int],
    num_steps: int = 3,
) -> OpenSurface:
    """As `open_surface` at a static capacity (vertices, quads): pure."""
    samples = _sampled(field, grid)
    return _mesh(field, grid, samples, _cuts(samples, grid), capacity, num_steps)


@eqx.filter_jit
def _sampled(field, grid):
    one = jax.vmap(jax.vmap(jax.value_and_grad(field)))
    values, slopes = jax.lax.map(one, grid.nodes())
    return _Samples(values, safe_normalize(slopes))


@eqx.filter_jit
def _cuts(samples, grid) -> Bool[Array, "3 x y z"]:
    """Whether the edge from each node along each axis is cut by the surface."""
    return jnp.stack([_cut_along(samples, grid, axis) for axis in range(3)])


def _cut_along(samples, grid, axis):
    ahead = lambda x: jnp.roll(x, -1, axis)
    h, before, after = grid.spacing[axis], samples.slopes, ahead(samples.slopes)
    facing = jnp.sum(before * after, axis=-1) < 0
    # The normal of the surface between the ends, and how far they are apart along it:
    # negative at a ridge, which lies between two sheets.
    rise = h * safe_normalize(after - before)[..., axis]
    total = samples.values + ahead(samples.values)
    last = total.shape[axis] - 1
    inner = jnp.indices(total.shape, sparse=True)[axis] < last
    return facing & (rise > 0) & (total <= rise + _SLACK * h) & inner


def _with_quad(cut):
    """The cut edges with four cells around them: not those on the sides of the grid."""
    index = jnp.indices(cut.shape[1:], sparse=True)
    rows = []
    for axis in range(3):
        fine = cut[axis]
        for other in {0, 1, 2} - {axis}:
            i, n = index[other], cut.shape[1 + other]
            fine &= (i > 0) & (i < n - 1)
        rows.append(fine)
    return jnp.stack(rows)


def _active(cut) -> Bool[Array, "x y z"]:
    """The cells (named by their lowest node) around the edges that have quads."""
    quads, cells = _with_quad(cut), jnp.zeros(cut.shape[1:], bool)
    for axis in range(3):
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for shift in ((0, 0), (1, 0), (0, 1), (1, 1)):
            cells |= jnp.roll(quads[axis], tuple(-s for s in shift), (b, c))
    return cells


@eqx.filter_jit
def _needs(cut):
    return jnp.sum(_active(cut)), jnp.sum(_with_quad(cut))


@eqx.filter_jit
def _mesh(field, grid, samples, cut, capacity, num_steps):
    most_vertices, most_quads = capacity
    active, quads = _active(cut), _with_quad(cut)
    cells = jnp.nonzero(active.reshape(-1), size=most_vertices, fill_value=active.size)
    starts = _starts(samples, grid, cut).reshape(-1, 3)
    at = starts.at[cells[0]].get(mode="fill", fill_value=0)
    vertices = _held(at, pull(field, at, num_steps), grid)
    number = jnp.full(active.size, most_vertices, jnp.int32)
    number = number.at[cells[0]].set(
        jnp.arange(most_vertices, dtype=jnp.int32), mode="drop"
    )
    corners = _quad_cells(quads, most_quads)
    named = number.at[corners].get(mode="fill", fill_value=most_vertices)
    # A quad with a missing vertex (the capacity ended) is no face.
    whole = jnp.all(named < most_vertices, axis=1, keepdims=True)
    named = jnp.where(whole, named, most_vertices)
    faces = jnp.concatenate([named[:, [0, 1, 2]], named[:, [0, 2, 3]]])
    faces = faces[jnp.argsort(faces[:, 0] >= most_vertices, stable=True)]
    num_vertices = jnp.sum(active).astype(jnp.int32)
    num_quads = jnp.sum(quads).astype(jnp.int32)
    real = jnp.sum(faces[:, 0] < most_vertices).astype(jnp.int32)
    held = jnp.minimum(num_vertices, most_vertices)
    mesh = TriangleMesh(vertices, faces, num_vertices=held, num_faces=real)
    full = (num_vertices > most_vertices) | (num_quads > most_quads)
    result = first_failure(
        failure_where(full, RESULTS.capacity_exceeded),
        failure_where(num_quads == 0, RESULTS.no_surface),
    )
    return OpenSurface(mesh, result, num_vertices, 2 * num_quads)


def _starts(samples, grid, cut):
    """The mean of the cuts of the 12 edges of each cell."""
    nodes = grid.nodes()
    total, count = jnp.zeros_like(nodes), jnp.zeros(grid.shape, nodes.dtype)
    for axis in range(3):
        ahead = jnp.roll(samples.values, -1, axis)
        sum_ = samples.values + ahead
        share = jnp.where(sum_ > 0, samples.values / jnp.where(sum_ > 0, sum_, 1), 0.5)
        point = nodes.at[..., axis].add(share * grid.spacing[axis])
        weight = cut[axis].astype(nodes.dtype)
        b, c = (axis + 1) % 3, (axis + 2) % 3
        for shift in ((0, 0), (1, 0), (0, 1), (1, 1)):
            back = tuple(-s for s in shift)
            near = jnp.roll(weight, back, (b, c))
            total += near[..., None] * jnp.roll(point, back, (b, c))
            count += near
    return total / jnp.maximum(count, 1)[..., None]


def _held(start, end, grid):
    """The pulled vertices, at most a cell from where they started."""
    reach = grid.spacing
    return start + jnp.clip(end - start, -reach, reach)


def _quad_cells(quads, most_quads) -> Int[Array, "m 4"]:
    """The four cells around each cut edge, counter-clockwise about its axis."""
    x, y, z = quads.shape[1:]
    size = x * y * z
    stride = np.asarray([y * z, z, 1])
    slot = jnp.nonzero(quads.reshape(-1), size=most_quads, fill_value=quads.size)[0]
    axis, node = slot // size, slot % size
    b = jnp.asarray(stride)[(axis + 1) % 3]
    c = jnp.asarray(stride)[(axis + 2) % 3]
    corners = jnp.stack([node - b - c, node - c, node, node - b], axis=1)
    return jnp.where((slot < quads.size)[:, None], corners, size).astype(jnp.int32)
