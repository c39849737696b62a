"""The host form of marching cubes on bricks: some bricks at a time, any size."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._core import bucket, from_host, host_zeros
from ..fields import NarrowBand
from ..shapes import TriangleMesh
from ._bits import popcount
from ._brick_bits import ROWS, active_cells, classify_bricks, cut_edges
from ._brick_cubes import band_status, place_vertices
from ._brick_faces import emit_brick_faces
from ._brick_vertices import bricks_beside
from ._extraction import Capacity, Extraction

_BRICKS = 4096


def extract_band(band: NarrowBand, method, token) -> Extraction:
    """The mesh of a narrow band, of exact size, in memory that its output sets."""
    bits, beside = _classified(band, method, token)
    counts = [np.asarray(x) for x in _per_brick(bits)]
    starts = range(0, int(band.num_bricks), _BRICKS)
    sums = [[int(c[i : i + _BRICKS].sum()) for c in counts] for i in starts]
    largest = [max((s[k] for s in sums), default=0) for k in range(3)]
    capacity = Capacity(*(bucket(n) for n in largest))
    total = np.sum(sums, axis=0, dtype=np.int64) if sums else np.zeros(3, np.int64)
    shape, held = (total[0], 3), band.values.dtype
    arrays = [host_zeros(shape, held), host_zeros((total[1], 3), np.int32)]
    if method.normals:
        arrays.append(host_zeros(shape, held))
    ends = [0, 0, 0]
    for start, (count, _, _) in zip(starts, sums, strict=True):
        part = _part(method, band, bits, beside, jnp.int32(start), capacity, token)
        for k, found in enumerate(_without_padding(*part, count)):
            arrays[k][ends[k] : ends[k] + len(found)] = found
            ends[k] += len(found)
    needed = bits.needed
    result = band_status(band, bits, Capacity(*(max(int(n), 1) for n in total)))
    filled = [a[:end] for a, end in zip(arrays, ends, strict=False)]
    mesh = TriangleMesh(*map(from_host, filled))
    return Extraction(mesh, result, needed.vertices, needed.faces, needed.cells)


def _without_padding(placed, faces, count):
    """The vertices, the faces and, if there are any, the normals of a part."""
    points, directed = placed
    yield np.asarray(points)[:count]
    yield np.asarray(faces.corners)[: int(faces.num_faces)]
    if directed is not None:
        yield np.asarray(directed)[:count]


@eqx.filter_jit
def _classified(band, method, token):
    return classify_bricks(band, method.ambiguity, token), bricks_beside(band)


@eqx.filter_jit
def _per_brick(bits):
    """The numbers of vertices, faces and cells of every brick."""
    count = lambda words: jnp.sum(popcount(words).reshape(-1, ROWS), axis=1)
    cells = count(active_cells(bits.words))
    return count(cut_edges(bits.words)), bits.faces, cells


@eqx.filter_jit
def _part(method, band, bits, beside, start, capacity, token):
    """The vertices, the normals and the faces of `_BRICKS` bricks from `start` on."""
    rows = start * ROWS + jnp.arange(_BRICKS * ROWS, dtype=jnp.int32)
    placed = place_vertices(
        band,
        bits,
        beside,
        rows,
        capacity.vertices,
        method.placement,
        method.normals,
        token,
    )
    every = jnp.int32(bits.words.shape[0])
    return placed, emit_brick_faces(bits, rows, every, capacity, token)
