"""How often a triangle mesh winds around points: inside or outside of anything."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core import check_shape, safe_norm
from ..shapes import TriangleMesh
from ._backends import in_tiles, usable
from ._fast_winding import fast_winding
from ._surface import index_surface

# Pairs of a point and a face that are in memory at once.
_PAIRS = 2**18


class AbstractWinding(eqx.Module):
    """How winding numbers are summed."""

    @abstractmethod
    def at(self, mesh: TriangleMesh, points: Float[Array, "q 3"]) -> Float[Array, " q"]:
        """The winding numbers at points."""


class Exact(AbstractWinding):
    """All faces for every point: q f angles in bounded memory, differentiable."""

    def at(self, mesh, points):
        """The sum of all solid angles."""
        corners, real = jnp.moveaxis(mesh.triangles(), 0, -1), mesh.face_mask
        # Backwards, the angles of a tile are computed again instead of kept.
        tile = jax.checkpoint(lambda rows: _angles(corners, real, rows) / (2 * np.pi))
        return in_tiles(tile, points, _PAIRS // max(corners.shape[-1], 1))


class Hierarchical(AbstractWinding):
    """Faces nearby exactly, far groups of them by three terms of their multipoles.

    A group counts as far from `beta` times its radius on: the error falls about as
    1 / beta^4. For inside and outside: its derivative is taken as zero (`Exact` has
    that of the angles).

    Source: G. Barill et al., Fast winding numbers for soups and clouds, 2018.
    """

    beta: float = 2.0

    def at(self, mesh, points):
        """The sum over the nodes of a tree."""
        # The numbers decide between two sides only: they have no gradient.
        still, points = jax.lax.stop_gradient((mesh, points))
        fixed, live = usable(points, jnp.ones(points.shape[0], bool))
        beta = jnp.asarray(self.beta, points.dtype)
        return jnp.where(live, fast_winding(index_surface(still), fixed, beta), jnp.nan)


def winding_number(
    mesh: TriangleMesh,
    points: Float[Array, "q 3"],
    *,
    method: AbstractWinding | None = None,
) -> Float[Array, " q"]:
    """The sum of the solid angles of all faces seen from points [q, 3], over 4 pi.

    For a face with corners a, b, c relative to the point,

        tan(angle / 2) = a . (b x c) / s
        s = |a| |b| |c| + (a . b) |c| + (b . c) |a| + (c . a) |b|

    Inside a closed mesh, counter-clockwise seen from outside, it is 1, outside 0; it
    falls smoothly across holes, so that more than 1/2 means inside for open, crossing
    or doubled surfaces too. On the surface itself it may be anything between the two
    sides. `method` is `Exact()` (the default; differentiable in both arguments) or
    `Hierarchical()`, for many points and faces. Not a number where a point is not
    finite; 0 without faces.

    Source: A. Van Oosterom, J. Strackee, The solid angle of a plane triangle, 1983,
    equation 8; A. Jacobson et al., Robust inside-outside segmentation using generalized
    winding numbers, 2013.
    """
    check_shape("points", points, (None, 3))
    method = Exact() if method is None else method
    return method.at(mesh, jnp.asarray(points, mesh.vertices.dtype))


def inside(
    mesh: TriangleMesh,
    points: Float[Array, "q 3"],
    *,
    method: AbstractWinding | None = None,
) -> Bool[Array, " q"]:
    """Where the winding number [q] of the mesh is more than 1/2.

    Right for closed meshes, counter-clockwise seen from outside, and the best guess for
    meshes with holes. `method` is `Hierarchical()` by default.
    """
    method = Hierarchical() if method is None else method
    return winding_number(mesh, points, method=method) > 0.5


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
