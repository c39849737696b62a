"""Curvatures of the surface at the vertices of a mesh."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import eigen_two, safe_divide, safe_norm, safe_normalize, tangents_to
from ..shapes import PrincipalCurvatures, TriangleMesh
from ._edge_list import boundary_vertices, edges
from ._geometry import (
    AngleWeights,
    SphereWeights,
    corners,
    face_normals,
    vertex_normals,
)
from ._laplacian import (
    MixedVoronoiAreas,
    cotangent_laplacian,
    lumped_mass,
    sum_at_vertices,
)
from ._small import solve_three


def mean_curvature_vectors(mesh: TriangleMesh) -> Float[Array, "v 3"]:
    """H n at every vertex: L x / (2 M), of length the mean curvature, 1 / length.

    H is the mean of the two principal curvatures (1 / r on a sphere of radius r); n
    points outward where the surface is convex. L is the cotangent Laplacian, M the
    mixed Voronoi area. Of no meaning on the boundary, where it is taken as zero; zero
    for padding and for vertices without faces.

    Source: M. Meyer et al., 2003, equation 8.
    """
    real = mesh.vertex_mask[:, None]
    points = jnp.where(real, mesh.vertices, 0)
    # Close to the origin the differences keep their digits.
    middle = jnp.sum(points, axis=0) / jnp.maximum(mesh.num_vertices, 1)
    rise = cotangent_laplacian(mesh) @ jnp.where(real, points - middle, 0)
    mass = lumped_mass(mesh, areas=MixedVoronoiAreas())
    inside = ~boundary_vertices(mesh) & (mass > 0)
    divisor = jnp.where(inside, mass, 0)[:, None]
    return safe_divide(rise, 2 * divisor)


def mean_curvature(mesh: TriangleMesh) -> Float[Array, " v"]:
    """The mean curvature (k_1 + k_2) / 2 at every vertex, positive where convex.

    The length of `mean_curvature_vectors` along the vertex normal: H n . n.
    """
    normals = vertex_normals(mesh, weights=AngleWeights())
    return jnp.sum(mean_curvature_vectors(mesh) * normals, axis=-1)


def angle_defects(mesh: TriangleMesh) -> Float[Array, " v"]:
    """2 pi minus the sum of the angles at every vertex (pi on the boundary).

    The integral of the Gaussian curvature around the vertex, and of the geodesic
    curvature of the boundary: the sum is 2 pi times the Euler characteristic (Gauss and
    Bonnet). That holds for every mesh: an edge with n faces takes pi (2 - n) / 2 from
    both of its ends. Zero for padding and for vertices without faces.
    """
    angles = AngleWeights().at_corners(corners(mesh))
    total = sum_at_vertices(mesh, angles)
    found = edges(mesh)
    lack = jnp.where(found.mask, jnp.pi / 2 * (2 - found.num_faces), 0)
    ends = jnp.broadcast_to(lack.astype(total.dtype)[:, None], found.vertices.shape)
    lack = jnp.zeros_like(total).at[found.vertices].add(ends, mode="drop")
    used = jnp.zeros(total.shape, bool).at[found.vertices].set(True, mode="drop")
    return jnp.where(used, 2 * jnp.pi - lack - total, 0)


def gaussian_curvature(mesh: TriangleMesh) -> Float[Array, " v"]:
    """The Gaussian curvature k_1 k_2 at every vertex: angle defect / mixed area.

    In 1 / length^2. On the boundary it is taken as zero.

    Source: M. Meyer et al., 2003, equation 9.
    """
    mass = lumped_mass(mesh, areas=MixedVoronoiAreas())
    mass = jnp.where(boundary_vertices(mesh), 0, mass)
    return safe_divide(angle_defects(mesh), mass)


def principal_curvatures(mesh: TriangleMesh) -> PrincipalCurvatures:
    """The principal curvatures and directions from the change of the vertex normals.

    In every face the symmetric matrix S (second fundamental form) is fitted to
    S e = n_j - n_i along its three sides; the matrices of the faces around a vertex are
    turned into its tangent plane and averaged by their parts of the mixed Voronoi area.
    Defined up to the boundary. Differentiable; the gradient of the values is that of
    their mean where they are equal.

    Zero for padding and for vertices without faces.

    Of second order on regular meshes; at vertices of irregular valence it may stay off
    however fine the mesh is. `clouds.principal_curvatures` of the vertices converges
    everywhere.

    Source: S. Rusinkiewicz, Estimating curvatures and their derivatives on triangle
    meshes, 2004.
    """
    triangles = corners(mesh)
    normals = vertex_normals(mesh, weights=SphereWeights())
    v = normals.shape[0]
    faces = jnp.where(mesh.face_mask[:, None], mesh.faces, v)
    at_corners = normals.at[faces].get(mode="fill", fill_value=0)
    shape = jax.vmap(_face_shape)(triangles, at_corners, face_normals(mesh))
    frames = jax.vmap(_frame)(normals)
    tangents = frames.at[faces].get(mode="fill", fill_value=0)
    turn = jax.vmap(jax.vmap(_into_plane, (0, 0, None, None)), (0, 0, 0, 0))
    turned = turn(at_corners, tangents, face_normals(mesh), shape)
    share = MixedVoronoiAreas().at_corners(triangles)
    total = sum_at_vertices(mesh, share[..., None, None] * turned)
    mass = sum_at_vertices(mesh, share)
    mean = safe_divide(total, mass[:, None, None])
    values, turns = jax.vmap(eigen_two)(mean)
    return PrincipalCurvatures(values, turns @ frames, normals)


def _face_shape(triangle, normals, normal):
    """The second fundamental form [3, 3] of one face, fitted to its three sides."""
    first = safe_normalize(triangle[1] - triangle[0])
    basis = jnp.stack([first, jnp.cross(normal, first)])
    sides = (jnp.roll(triangle, -1, axis=0) - triangle) @ basis.T
    turns = (jnp.roll(normals, -1, axis=0) - normals) @ basis.T
    scale = safe_norm(sides.reshape(-1))
    x, y = safe_divide(sides, scale).T
    zero = jnp.zeros_like(x)
    matrix = jnp.stack([jnp.stack([x, y, zero], -1), jnp.stack([zero, x, y], -1)])
    matrix = matrix.reshape(6, 3)
    target = safe_divide(turns, scale).T.reshape(6)
    e, f, g = solve_three(matrix.T @ matrix, matrix.T @ target)
    return basis.T @ jnp.array([[e, f], [f, g]]) @ basis


def _frame(normal):
    """Two unit tangents [2, 3]; zero where there is no normal."""
    return jnp.where(jnp.any(normal != 0), tangents_to(normal), 0)


def _into_plane(normal, tangents, face_normal, shape):
    """The form of a face, turned with its normal into the plane of a vertex [2, 2]."""
    axis = jnp.cross(normal, face_normal)
    cosine = jnp.dot(normal, face_normal)
    # The shortest turn that takes the normal of the vertex to that of the face.
    safe = jnp.where(cosine > -0.5, 1 + cosine, 1)
    turned = jax.vmap(
        lambda x: cosine * x + jnp.cross(axis, x) + axis * jnp.dot(axis, x) / safe
    )(tangents)
    return turned @ shape @ turned.T
