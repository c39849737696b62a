"""Points of space with their true distance to a mesh: what networks are taught."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from ..meshes import sample_surface
from ..neighbors import closest_on_mesh, signed_distance
from ..shapes import TriangleMesh
from ._losses import Samples


def signed_samples(
    mesh: TriangleMesh,
    num: int,
    *,
    key: Key[Array, ""],
    spreads: tuple[float, ...] = (0.01, 0.05),
    reach: float = 0.6,
) -> Samples:
    """`num` points with their signed distance to a closed mesh (negative inside).

    A share of 1 / (k + 1) each lies about the surface with normal deviates of each of
    the k `spreads`, and the rest is uniform in the cube [-reach, reach]^3; lengths are
    in the unit of the mesh. Pure; `num` and `spreads` are static under jit.

    Source: J. J. Park et al., DeepSDF, 2019, section 5.
    """
    points = space_points(mesh, num, key=key, spreads=spreads, reach=reach)
    return Samples(points, signed_distance(mesh, points).distances)


def unsigned_samples(
    mesh: TriangleMesh,
    num: int,
    *,
    key: Key[Array, ""],
    spreads: tuple[float, ...] = (0.01, 0.05),
    reach: float = 0.6,
) -> Samples:
    """As `signed_samples`, with the distance to a mesh that may be open."""
    points = space_points(mesh, num, key=key, spreads=spreads, reach=reach)
    return Samples(points, closest_on_mesh(mesh, points).distances)


def space_points(
    mesh: TriangleMesh,
    num: int,
    *,
    key: Key[Array, ""],
    spreads: tuple[float, ...],
    reach: float,
) -> Float[Array, "m 3"]:
    """Points about a mesh, at several scales, and in a cube (see `signed_samples`)."""
    key_surface, key_noise, key_cube = jax.random.split(key, 3)
    share = num // (len(spreads) + 1)
    dtype = mesh.vertices.dtype
    on = sample_surface(mesh, share * len(spreads), key=key_surface).points
    scale = jnp.repeat(jnp.asarray(spreads, dtype), share)[:, None]
    near = on + scale * jax.random.normal(key_noise, on.shape, dtype)
    rest = (num - share * len(spreads), 3)
    far = reach * jax.random.uniform(key_cube, rest, dtype, -1.0, 1.0)
    return jnp.concatenate([near, far])
