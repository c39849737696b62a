"""Triangles by the lengths of their sides: cotangents that stay finite."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide, safe_norm
from ..shapes import TriangleMesh
from ._geometry import corners
from ._topology import proper_faces

# The slack of the triangle inequality, in mean edge lengths, below which all sides
# grow: that of Sharp and Crane in double precision, more where it would be rounded off.
_SLACK = 1e-5
_ROUNDINGS = 256


class FlatFaces(eqx.Module):
    """Every face laid into the plane, and what follows from its sides.

    `lengths` [f, 3]: of the side opposite to each corner; `cotangents` [f, 3] of the
    corners; `areas` [f]; `sides` [f, 3, 2]: the vector of the side opposite to each
    corner, from the next corner to the one after it. All zero for padding
    and for faces that name a vertex twice.
    """

    lengths: Float[Array, "f 3"]
    cotangents: Float[Array, "f 3"]
    areas: Float[Array, " f"]
    sides: Float[Array, "f 3 2"]


def flat_triangles(mesh: TriangleMesh) -> FlatFaces:
    """The faces of a mesh from their lengths, mollified.

    Where a face is (nearly) without area, all lengths of the mesh grow by the same
    small amount, such that l_j + l_k >= l_i + slack everywhere and all cotangents are
    finite. A mesh of sound triangles is not changed.

    Source: N. Sharp, K. Crane, A Laplacian for nonmanifold triangle meshes, 2020,
    section 4.5.
    """
    triangles = corners(mesh)
    to_next = jnp.roll(triangles, -1, axis=1) - triangles
    lengths = safe_norm(jnp.roll(to_next, -1, axis=1))
    real = proper_faces(mesh)
    fixed = jax.lax.stop_gradient(lengths)
    share = max(_SLACK, _ROUNDINGS * float(jnp.finfo(lengths.dtype).eps))
    number = jnp.maximum(jnp.sum(real), 1)
    slack = share * jnp.sum(fixed) / (3 * number)
    excess = jnp.sum(fixed, axis=1) - 2 * jnp.max(fixed, axis=1)
    lacking = jnp.where(real, slack - excess, 0)
    lengths = lengths + jnp.maximum(jnp.max(lacking, initial=0), 0)
    lengths = jnp.where(real[:, None], lengths, 0)
    return _laid_out(lengths)


def _laid_out(lengths):
    a, b, c = (lengths[:, d] for d in range(3))
    areas = _heron(a, b, c)
    squares = lengths**2
    opposite = jnp.sum(squares, axis=1, keepdims=True) - 2 * squares
    cotangents = safe_divide(opposite, 4 * areas[:, None])
    # Corner 0 at the origin, corner 1 on the first axis.
    x = safe_divide(b**2 + c**2 - a**2, 2 * c)
    y = safe_divide(2 * areas, c)
    zero = jnp.zeros_like(c)
    plane = jnp.stack([zero, zero, c, zero, x, y], axis=-1).reshape(-1, 3, 2)
    sides = jnp.roll(plane, -2, axis=1) - jnp.roll(plane, -1, axis=1)
    return FlatFaces(lengths, cotangents, areas, sides)


def _heron(a, b, c):
    """The area from the sides, without cancellation (W. Kahan)."""
    low, middle, high = jnp.sort(jnp.stack([a, b, c]), axis=0)
    square = (
        (high + (middle + low))
        * (low - (high - middle))
        * (low + (high - middle))
        * (high + (middle - low))
    )
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1)), 0) / 4
