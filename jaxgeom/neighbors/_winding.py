"""How often a triangle mesh winds around points: inside or outside of anything."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import check_shape, safe_norm
from ..shapes import TriangleMesh
from ._backends import in_tiles

# Pairs of a point and a face that are in memory at once.
_PAIRS = 2**18


def winding_number(
    mesh: TriangleMesh, points: Float[Array, "q 3"]
) -> Float[Array, " q"]:
    """The sum of the solid angles of all faces seen from points [q, 3], over 4 pi.

    For a face with corners a, b, c relative to the point,

        tan(angle / 2) = a . (b x c) / s
        s = |a| |b| |c| + (a . b) |c| + (b . c) |a| + (c . a) |b|

    Inside a closed mesh, counter-clockwise seen from outside, it is 1, outside 0; it
    falls smoothly across holes, so that more than 1/2 means inside for open, crossing
    or doubled surfaces too. On the surface itself it may be anything between the two
    sides. Exact, q f evaluations in bounded memory; differentiable in both arguments.
    Not a number where a point is not finite; 0 without faces.

    Source: A. Van Oosterom, J. Strackee, The solid angle of a plane triangle, 1983,
    equation 8; A. Jacobson et al., Robust inside-outside segmentation using generalized
    winding numbers, 2013.
    """
    check_shape("points", points, (None, 3))
    points = jnp.asarray(points, mesh.vertices.dtype)
    corners, real = jnp.moveaxis(mesh.triangles(), 0, -1), mesh.face_mask
    # Backwards, the angles of a tile are computed again instead of kept.
    tile = jax.checkpoint(lambda rows: _angles(corners, real, rows) / (2 * np.pi))
    return in_tiles(tile, points, _PAIRS // max(corners.shape[-1], 1))


def _angles(corners, real, points) -> Float[Array, " t"]:
    """Half the sum of the solid angles of the corners [3, 3, f] at points [t, 3]."""
    away = lambda x: jnp.stack([x[d] - points[:, d, None] for d in range(3)])
    a, b, c = (away(x) for x in corners)
    dot = lambda x, y: jnp.sum(x * y, axis=0)
    la, lb, lc = (safe_norm(x, axis=0) for x in (a, b, c))
    volume = dot(a, jnp.cross(b, c, axis=0))
    spread = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    # At a corner both are zero, where the arc tangent has no gradient.
    some = (volume != 0) | (spread != 0)
    angles = jnp.arctan2(volume, jnp.where(some, spread, 1))
    return jnp.sum(jnp.where(real, angles, 0), axis=-1)
