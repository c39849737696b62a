"""Marching cubes with shared vertices, at the speed of counting bits.

Classify: the sign of every node is packed into words; exclusive-or of neighbor words
gives the cut edges. Compact: prefix sums of popcounts number vertices and cells. Place:
the k-th vertex finds its edge by rank. Emit: a face names its vertices by the rank of
the cut edges, without a table of ids. Work after packing grows with the surface.

Lorensen and Cline (1987); the case table is derived in `_tables.py`.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from .._core import (
    RESULTS,
    GeometryError,
    check_shape,
    failure_where,
    first_failure,
    message,
    stage,
)
from ..shapes import Grid, TriangleMesh
from ._ambiguity import AbstractFaceRule, SeparateInside
from ._classify import Counts, classify
from ._extraction import Capacity, Extraction
from ._faces import emit_faces
from ._placement import AbstractPlacement, Linear
from ._vertices import Samples, directions, find_edges, positions

# A sample on the level would put all vertices around it on one spot, and give faces
# without area: vertices keep this distance from the nodes, in cells.
CLEARANCE = 1e-3

_LINEAR = Linear()
_SEPARATE = SeparateInside()


class MarchingCubes(eqx.Module):
    """Settings of marching cubes.

    - `placement`: where vertices lie on their edges, `Linear()` or `Cubic()`.
    - `ambiguity`: of faces with the inside at both ends of a diagonal,
      `SeparateInside()` or `AsymptoticDecider()`.
    - `normals`: static; whether vertex normals are computed.
    """

    placement: AbstractPlacement = _LINEAR
    ambiguity: AbstractFaceRule = _SEPARATE
    normals: bool = eqx.field(static=True, default=True)

    def __call__(
        self, values, grid, level=0.0, *, capacity, field=None, token=None
    ) -> Extraction:
        """The level set of sampled values; see `marching_cubes`. The field behind them
        is not used."""
        return marching_cubes(
            values,
            grid,
            level,
            capacity=capacity,
            placement=self.placement,
            ambiguity=self.ambiguity,
            normals=self.normals,
            token=token,
        )

    def measure(self, values, level=0.0, *, token=None) -> Counts:
        """The sizes that the extraction needs, without making it."""
        return count(values, level, ambiguity=self.ambiguity, token=token)


def marching_cubes(
    values: Float[Array, "x y z"],
    grid: Grid,
    level: Float[Array, ""] | float = 0.0,
    *,
    capacity: Capacity,
    placement: AbstractPlacement = _LINEAR,
    ambiguity: AbstractFaceRule = _SEPARATE,
    normals: bool = True,
    token: Bool[Array, ""] | None = None,
) -> Extraction:
    """The surface where a sampled field equals `level`, as a mesh that shares vertices,
    oriented toward growing values.

    Inside is values < level, strictly. Edges of the mesh are shared by exactly two
    faces, except on the sides of the grid. Vertices lie on grid edges, by default at
    t = (level - f0) / (f1 - f0), at least 1/1000 of a cell from the nodes. Positions
    and normals have the derivatives of these formulas with respect to values, level,
    origin and spacing (zero along the edge where t is held); the faces have none.

    **Arguments:**

    - `values`: [x, y, z] samples at the nodes of `grid`, at least 2 along each axis.
    - `capacity`: static sizes; `count` measures them, `extract` does all of it.
    - `placement`: `Linear()`, or `Cubic()` for smooth fields.
    - `ambiguity`: `SeparateInside()`, or `AsymptoticDecider()`, which connects across
      the faces of the grid as the trilinear interpolant does.
    - `normals`: static; unit vertex normals from central differences of the values.
    - `token`: a run-time true that keeps stages apart on CPUs (see `stage`), or None.

    **Statuses:** `capacity_exceeded`, `nonfinite_input`, `no_surface`.

    Raises `GeometryError` unless `values` has the shape of the grid, or if vertex
    numbers might not fit 32 bits.
    """
    values, level = as_float(values, level)
    check_grid(values, grid)
    # The sign of a sample is piecewise constant: the topology has no derivative.
    bits, numbers = classify(*lax.stop_gradient((values, level)), ambiguity, token)
    edges = find_edges(bits, numbers, values.shape[2], capacity.vertices, token)
    t = stage(token, lambda *a: _parameter(placement, *a), values, edges, level)
    vertices = stage(token, positions, t, edges, grid)
    real = jnp.arange(capacity.vertices) < numbers.needed.vertices
    directed = None
    if normals:
        directed = directions(t, Samples(values, edges), grid, token)
        directed = jnp.where(real[:, None], directed, 0.0)
    vertices = jnp.where(real[:, None], vertices, 0.0)
    faces = emit_faces(bits, numbers, capacity, token)
    num_vertices = jnp.minimum(numbers.needed.vertices, capacity.vertices)
    mesh = TriangleMesh(
        vertices, faces.corners, directed, None, num_vertices, faces.num_faces
    )
    return finish(mesh, numbers.needed, bits.finite, capacity)


def count(
    values: Float[Array, "x y z"],
    level: Float[Array, ""] | float = 0.0,
    *,
    ambiguity: AbstractFaceRule = _SEPARATE,
    token: Bool[Array, ""] | None = None,
) -> Counts:
    """The numbers of vertices, faces and active cells of `marching_cubes`.

    With a decider the number of faces is an upper bound, near where faces of the grid
    are seldom ambiguous.
    """
    return classify(*as_float(values, level), ambiguity, token)[1].needed


def as_float(values, level):
    """Values and level as numbers of one floating type."""
    values = jnp.asarray(values)
    if not jnp.issubdtype(values.dtype, jnp.floating):
        values = values.astype(float)
    return values, jnp.asarray(level, values.dtype)


def _parameter(placement, values, edges, level):
    t = placement(Samples(values, edges), level)
    return jnp.clip(t, CLEARANCE, 1 - CLEARANCE)


def check_grid(values, grid):
    """Raise unless the values have the shape of the grid and edges fit 32 bits."""
    check_shape("values", values, grid.shape)
    if np.prod(np.asarray(grid.shape, float)) * 3 >= 2**31:
        raise GeometryError(
            message(
                "a grid may have at most 2^31 / 3 nodes (about 894 an axis)",
                f"shape {grid.shape}",
                "Extract it in blocks, or at a lower resolution.",
            )
        )


def finish(mesh, needed, finite, capacity) -> Extraction:
    """The mesh with its status."""
    short = (
        (needed.vertices > capacity.vertices)
        | (needed.faces > capacity.faces)
        | (needed.cells > capacity.cells)
    )
    result = first_failure(
        failure_where(short, RESULTS.capacity_exceeded),
        failure_where(~finite, RESULTS.nonfinite_input),
        failure_where(needed.vertices == 0, RESULTS.no_surface),
    )
    return Extraction(mesh, result, needed.vertices, needed.faces, needed.cells)
