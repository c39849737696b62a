"""Closest points of a target for the vertices of a mesh that deforms."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import RESULTS, failure_where, safe_normalize
from ..meshes import face_normals, vertex_normals
from ..neighbors import build, closest_on_mesh, index_surface, knn
from ..shapes import TriangleMesh


class Matches(eqx.Module):
    """Closest points [v, 3] with unit normals (zero where unknown), where `mask`."""

    points: Float[Array, "v 3"]
    normals: Float[Array, "v 3"]
    mask: Bool[Array, " v"]


def finder(target, inside):
    """vertices -> closest points of the target, prepared once; and its status."""
    if isinstance(target, TriangleMesh):
        target = eqx.tree_at(lambda m: m.vertices, target, inside(target.vertices))
        index, normals = index_surface(target), face_normals(target)

        def on_mesh(vertices):
            near = closest_on_mesh(index, vertices)
            toward = normals.at[near.faces].get(mode="fill", fill_value=0)
            return Matches(near.points, toward, near.mask)

        return on_mesh, failure_where(~jnp.any(target.face_mask), RESULTS.no_surface)
    cloud = target.washed()
    points = inside(cloud.points)
    given = jnp.zeros_like(points) if cloud.normals is None else cloud.normals
    index, normals = build(points, cloud.mask), safe_normalize(given)

    def on_cloud(vertices):
        near = knn(index, vertices, 1)
        row, mask = near.indices[:, 0], near.mask[:, 0]
        take = lambda x: x.at[row].get(mode="fill", fill_value=0)
        return Matches(take(points), take(normals), mask)

    return on_cloud, failure_where(~jnp.any(cloud.mask), RESULTS.too_few_points)


def matched(mesh: TriangleMesh, conditions, find, vertices) -> Matches:
    """Closest points, without those that are too far or whose normals disagree."""
    found = find(vertices)
    gap = jnp.sum((vertices - found.points) ** 2, axis=-1)
    moved = TriangleMesh(
        vertices,
        mesh.faces,
        num_vertices=mesh.num_vertices,
        num_faces=mesh.num_faces,
    )
    cosine = jnp.sum(vertex_normals(moved) * found.normals, axis=-1)
    unknown = jnp.all(found.normals == 0, axis=-1)
    agrees = unknown | (cosine >= conditions.least_cosine)
    near = gap <= conditions.max_distance**2
    # Correspondences are discrete: the step moves vertices, not what they match.
    return jax.lax.stop_gradient(
        Matches(
            found.points, found.normals, found.mask & mesh.vertex_mask & near & agrees
        )
    )


def across(vertices, matches: Matches, tangential) -> Float[Array, "v 3"]:
    """The gap to the closest point, of its part along the surface only a share.

    D gap with D = n n^T + sqrt(tangential) (I - n n^T); all of it without a normal.
    """
    gap = vertices - matches.points
    height = jnp.sum(matches.normals * gap, axis=-1, keepdims=True) * matches.normals
    known = jnp.any(matches.normals != 0, axis=-1, keepdims=True)
    share = jnp.where(known, jnp.sqrt(jnp.asarray(tangential, gap.dtype)), 1)
    return height + share * (gap - height)
