"""Which faces of a mesh a distribution of fields supports: probabilistic trimming."""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..linear import interpolate
from ..meshes import face_normals
from ..shapes import Grid, TriangleMesh


def face_probability(
    mesh: TriangleMesh,
    samples: Float[Array, "s x y z"],
    grid: Grid,
    *,
    distance: Float[Array, ""] | float,
) -> Float[Array, " f"]:
    """The probability [f] that the surface passes within `distance` of each face.

    The event: along the normal n through the centroid c, the field has unlike signs at
    c - d n and c + d n. What comes out is the share of the sampled fields in which it
    has: with s samples its deviation is at most 1 / (2 sqrt(s)). A surface that crosses
    the segment twice, such as both sides of a thin wall, is not counted.
    A piecewise constant number, so its gradient is zero. Padding, and faces whose
    segment leaves the grid, have probability 0; NaN where a sample is NaN.

    To trim a mesh where a scan does not say where the surface is:

        keep = face_probability(mesh, samples, grid, distance=0.02) >= 0.9
        trimmed = meshes.keep_faces(mesh, keep)

    **Arguments:** `samples` of `Posterior.samples` on the nodes of `grid`; `distance`
    in the unit of the mesh.

    For the distribution see Sellan and Jacobson (2022), as in `stochastic_poisson`.
    """
    center = jnp.mean(mesh.triangles(), axis=1)
    step = distance * face_normals(mesh)
    ends = jnp.stack([center - step, center + step])
    within = jnp.all(grid.holds(ends), axis=0) & mesh.face_mask
    q = grid.index_of(ends.reshape(-1, 3))

    def crossed(values):
        inner, outer = interpolate(values, q).reshape(2, -1)
        known = jnp.isfinite(inner) & jnp.isfinite(outer)
        return jnp.where(known, (inner < 0) != (outer < 0), jnp.nan)

    share = jnp.mean(lax.map(crossed, samples), axis=0).astype(samples.dtype)
    return jnp.where(within, share, 0)
