"""Marching cubes on the bricks of a narrow band, welded without a seam."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from .._core import (
    RESULTS,
    failure_where,
    first_failure,
    stage,
)
from ..fields import NarrowBand
from ..shapes import TriangleMesh
from ._ambiguity import AbstractFaceRule, SeparateInside
from ._bits import expand, popcount
from ._brick_bits import ROWS, BrickBits, classify_bricks, cut_edges
from ._brick_faces import emit_brick_faces
from ._brick_vertices import (
    BrickSamples,
    brick_directions,
    brick_positions,
    bricks_beside,
    edges_of,
)
from ._classify import Counts
from ._extraction import Capacity, Extraction
from ._marching_cubes import CLEARANCE
from ._placement import AbstractPlacement, Linear

_LINEAR = Linear()
_SEPARATE = SeparateInside()


def marching_cubes_on_bricks(
    band: NarrowBand,
    *,
    capacity: Capacity,
    placement: AbstractPlacement = _LINEAR,
    ambiguity: AbstractFaceRule = _SEPARATE,
    normals: bool = True,
    token: Bool[Array, ""] | None = None,
) -> Extraction:
    """The surface of a narrow band: `marching_cubes` of the whole grid, without it.

    The same vertices and faces as from dense samples, in another order: a vertex
    belongs to the brick of the lower node of its edge, and faces of other bricks name
    it by its rank there. Derivatives reach the values of the band. `extract(band)`
    measures the capacity.

    Where the band ends, `Cubic()` and the normals see fewer samples than the dense
    grid has: quadratics and one-sided differences.

    **Statuses:** those of the band, `steep_field` (the surface leaves the band, which
    the Lipschitz constant should have prevented: it has a hole there), then those of
    `marching_cubes`.
    """
    # The sign of a sample is piecewise constant: the topology has no derivative.
    fixed = jax.tree.map(lax.stop_gradient, band)
    bits = classify_bricks(fixed, ambiguity, token)
    rows = jnp.arange(bits.words.shape[0], dtype=jnp.int32)
    beside = stage(token, bricks_beside, fixed)
    vertices, directed = place_vertices(
        band, bits, beside, rows, capacity.vertices, placement, normals, token
    )
    limit = _row_limit(bits, capacity)
    faces = emit_brick_faces(bits, rows, limit, capacity, token)
    num_vertices = jnp.minimum(bits.needed.vertices, capacity.vertices)
    mesh = TriangleMesh(
        vertices, faces.corners, directed, None, num_vertices, faces.num_faces
    )
    needed = bits.needed
    return Extraction(
        mesh,
        band_status(band, bits, capacity),
        needed.vertices,
        needed.faces,
        needed.cells,
    )


def count_on_bricks(
    band: NarrowBand,
    *,
    ambiguity: AbstractFaceRule = _SEPARATE,
    token: Bool[Array, ""] | None = None,
) -> Counts:
    """The sizes that `marching_cubes_on_bricks` needs; see `count`."""
    return classify_bricks(band, ambiguity, token).needed


def place_vertices(
    band: NarrowBand,
    bits: BrickBits,
    beside,
    rows: Int[Array, " r"],
    capacity: int,
    placement: AbstractPlacement,
    normals: bool,
    token,
):
    """The vertices on the edges of `rows`, neighbors in order, and their normals."""
    words = bits.words.at[rows].get(mode="fill", fill_value=0)
    counts = popcount(cut_edges(words))
    starts = bits.first_vertex.at[rows].get(mode="clip")
    starts = starts - starts[0]
    owners = expand(counts, starts, capacity, token)
    pick = lambda o: edges_of(o, rows, bits.words)
    samples = BrickSamples(band, beside, stage(token, pick, owners))
    t = stage(token, lambda s: _parameter(placement, s), samples)
    real = (jnp.arange(capacity) < jnp.sum(counts))[:, None]
    points = stage(token, brick_positions, t, samples)
    directed = brick_directions(t, samples, token) if normals else None
    wash = lambda x: None if x is None else jnp.where(real, x, 0.0)
    return wash(points), wash(directed)


def band_status(band: NarrowBand, bits: BrickBits, capacity: Capacity) -> RESULTS:
    """What the extraction of a band has to report."""
    short = (
        (bits.needed.vertices > capacity.vertices)
        | (bits.needed.faces > capacity.faces)
        | (bits.needed.cells > capacity.cells)
    )
    return first_failure(
        failure_where(short, RESULTS.capacity_exceeded),
        band.result,
        failure_where(~bits.finite, RESULTS.nonfinite_input),
        failure_where(bits.broken, RESULTS.steep_field),
        failure_where(bits.needed.vertices == 0, RESULTS.no_surface),
    )


def _parameter(placement, samples):
    zero = jnp.zeros((), samples.band.values.dtype)
    return jnp.clip(placement(samples, zero), CLEARANCE, 1 - CLEARANCE)


def _row_limit(bits, capacity):
    """The row before which all vertices of all cells fit the capacity.

    Cells name vertices of the bricks ahead: bricks count while all of these fit.
    """
    counts = popcount(cut_edges(bits.words))
    ends = (bits.first_vertex + counts).reshape(-1, ROWS)[:, -1]
    ahead = bits.neighbors.reshape(-1, 8)
    last = jnp.max(ends.at[ahead].get(mode="fill", fill_value=0), axis=1)
    fitting = jnp.cumsum(last > capacity.vertices) == 0
    return jnp.sum(fitting, dtype=jnp.int32) * ROWS
