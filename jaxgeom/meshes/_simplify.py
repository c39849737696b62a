"""Fewer faces: vertices clustered on a grid, and edges collapsed by a library."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, message, prefix_sum, safe_divide
from ..shapes import TriangleMesh
from ._geometry import corners, doubled
from ._selection import keep_faces
from ._small import solve_three

# Weight of staying at the mean of the cluster, beside the planes of the faces.
_STAY = 1e-3


def cluster_vertices(
    mesh: TriangleMesh, cell: Float[Array, ""] | float
) -> TriangleMesh:
    """The mesh with one vertex for all vertices in a cubic cell of width `cell`.

    It lies where the sum of squared distances to the planes of their faces, weighted by
    area^2, is least: sharp edges stay. Among equally good places it is the one nearest
    to the mean of the cluster, and it never leaves the cell. Faces within two cells
    vanish, and faces that fold onto each other cancel, so that a closed oriented mesh
    stays closed and oriented; thin parts may come out non-manifold. Attributes become
    the mean of their cluster; normals are dropped.

    Capacities stay, counts shrink (on the host, `trim()`). `cell` is a length.
    Differentiable in the vertices for fixed clusters.

    Source: P. Lindstrom, Out-of-core simplification of large polygonal models, 2000.
    """
    v = mesh.vertices.shape[0]
    real = mesh.vertex_mask
    points = jnp.where(real[:, None], mesh.vertices, 0)
    # Which cell a vertex is in is a discrete choice: it has no gradient.
    low = jnp.min(jnp.where(real[:, None], points, jnp.inf), axis=0, initial=jnp.inf)
    low = jax.lax.stop_gradient(jnp.where(jnp.isfinite(low), low, 0))
    width = jax.lax.stop_gradient(jnp.asarray(cell, points.dtype))
    cells = jnp.floor(jax.lax.stop_gradient(points - low) / width).astype(jnp.int32)
    label = _ranks(cells, real)
    mean = lambda x: _cluster_mean(x, label)
    middle = mean(points)
    corner = low + width * _first_of(cells, label)
    placed = middle + _least_error(mesh, label, middle)
    placed = jnp.clip(placed, corner, corner + width)
    faces = label.at[mesh.faces].get(mode="fill", fill_value=v)
    number = jnp.max(jnp.where(real, label, -1), initial=-1) + 1
    clustered = TriangleMesh(
        jnp.where((jnp.arange(v) < number)[:, None], placed, 0),
        faces,
        None,
        {name: mean(jnp.asarray(x)) for name, x in mesh.attributes.items()},
        num_vertices=number,
        num_faces=mesh.num_faces,
    )
    return keep_faces(clustered, _uncancelled(faces, mesh.face_mask))


def decimate(
    mesh: TriangleMesh, num_faces: int, *, aggressiveness: float = 7.0
) -> TriangleMesh:
    """The mesh with about `num_faces` faces, by collapsing edges (host).

    The library fast_simplification does it: quadric errors, on the CPU, exact sizes,
    not differentiable. A lower `aggressiveness` is slower and better. Normals and
    attributes are dropped. Raises `GeometryError` where it is not installed, and unless
    0 < `num_faces`; a mesh with no more faces than that comes back as it is.

    Source: M. Garland, P. S. Heckbert, Surface simplification using quadric error
    metrics, 1997.
    """
    if num_faces < 1:
        must = "num_faces must be at least 1"
        raise GeometryError(message(must, f"{num_faces}", "Pass a larger number."))
    try:
        import fast_simplification
    except ImportError as error:
        must = "edge collapse needs the library fast_simplification"
        fix = "Run `pip install fast-simplification`, or use `cluster_vertices`."
        raise GeometryError(message(must, "it is not installed", fix)) from error
    mesh = mesh.trim()
    if mesh.faces.shape[0] <= num_faces:
        return mesh
    # Copies: the library refuses arrays that it may not write to.
    vertices, faces = fast_simplification.simplify(
        np.array(mesh.vertices),
        np.array(mesh.faces),
        target_count=num_faces,
        agg=aggressiveness,
    )
    dtype = mesh.vertices.dtype
    return TriangleMesh(jnp.asarray(vertices, dtype), jnp.asarray(faces, jnp.int32))


def _ranks(cells, real):
    """The number of the cell of every vertex, in order of the cells; v for padding."""
    v = real.shape[0]
    last = jnp.iinfo(jnp.int32).max
    x, y, z = (jnp.where(real, cells[:, d], last) for d in range(3))
    order = jnp.arange(v, dtype=jnp.int32)
    x, y, z, order = jax.lax.sort((x, y, z, order), num_keys=3)
    new = (x[1:] != x[:-1]) | (y[1:] != y[:-1]) | (z[1:] != z[:-1])
    head = jnp.pad(new, (1, 0), constant_values=True).astype(jnp.int32)
    number = (prefix_sum(head) + head - 1)[:v]
    rank = jnp.zeros(v, jnp.int32).at[order].set(number)
    return jnp.where(real, rank, v)


def _cluster_mean(x, label):
    v = label.shape[0]
    total = jnp.zeros_like(x).at[label].add(x, mode="drop")
    number = jnp.zeros(v, x.dtype).at[label].add(1, mode="drop")
    return safe_divide(total, number.reshape(-1, *[1] * (x.ndim - 1)))


def _first_of(cells, label):
    return jnp.zeros_like(cells).at[label].max(cells, mode="drop")


def _least_error(mesh, label, middle):
    """From the middle of each cluster to where its planes are nearest."""
    v = label.shape[0]
    triangles = corners(mesh)
    normals = doubled(triangles)
    # In units of the largest face: fourth powers of lengths would underflow.
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(normals), initial=0))
    normals = normals / jnp.where(largest > 0, largest, 1)
    at = label.at[mesh.faces].get(mode="fill", fill_value=v)
    at = jnp.where(mesh.face_mask[:, None], at, v)
    near = middle.at[at].get(mode="fill", fill_value=0)
    height = jnp.einsum("fi,fdi->fd", normals, triangles - near)
    planes = normals[:, :, None] * normals[:, None]
    planes = jnp.broadcast_to(planes[:, None], (*at.shape, 3, 3))
    matrix = jnp.zeros((v, 3, 3), normals.dtype).at[at].add(planes, mode="drop")
    right = normals[:, None] * height[..., None]
    right = jnp.zeros((v, 3), normals.dtype).at[at].add(right, mode="drop")
    size = jnp.trace(matrix, axis1=1, axis2=2)
    matrix = safe_divide(matrix, size[:, None, None]) + _STAY * jnp.eye(3)
    step = jax.vmap(solve_three)(
        matrix.astype(right.dtype), safe_divide(right, size[:, None])
    )
    return step


def _uncancelled(faces, real):
    """True for the faces that are left when opposite ones cancel.

    Of the faces on the same three vertices, as many stay as there are more of one
    winding than of the other.
    """
    f = faces.shape[0]
    a, b, c = (faces[:, d] for d in range(3))
    proper = real & (a != b) & (b != c) & (c != a)
    low, middle, high = jnp.sort(faces, axis=1).T
    even = ((a < b) & (b < c)) | ((b < c) & (c < a)) | ((c < a) & (a < b))
    last = jnp.iinfo(jnp.int32).max
    keys = (jnp.where(proper, low, last), middle, high)
    order = jnp.arange(f, dtype=jnp.int32)
    *keys, even, order = jax.lax.sort((*keys, even, order), num_keys=4)
    start = jnp.arange(f) == 0
    for key in keys:
        start |= jnp.pad(key[1:] != key[:-1], (f > 0, 0), constant_values=True)
    group = prefix_sum(start.astype(jnp.int32)) + start - 1
    count = lambda x: jnp.zeros(f, jnp.int32).at[group].add(x.astype(jnp.int32))[group]
    evens, odds = count(even), count(~even)
    first = jax.lax.cummax(jnp.where(start, jnp.arange(f, dtype=jnp.int32), 0))
    # Odd ones come first within their group.
    place = jnp.arange(f, dtype=jnp.int32) - first - jnp.where(even, odds, 0)
    excess = jnp.where(even, evens - odds, odds - evens)
    return jnp.zeros(f, bool).at[order].set(place < excess) & proper
