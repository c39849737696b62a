"""Where points lie in triangles, and what lies there."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._core import check_shape, safe_divide, safe_normalize
from ..shapes import TriangleMesh
from ._geometry import interpolate, vertex_normals


def barycentric(
    triangle: Float[Array, "3 d"], point: Float[Array, " d"]
) -> Float[Array, " 3"]:
    """The b with sum b = 1 that makes |b_0 a + b_1 b + b_2 c - point| least.

    In the plane (d = 2) these are the coordinates of the point, in space those of its
    foot; they are negative outside. In a triangle without area the foot is that on the
    longest side. For many points map it:
    `jax.vmap(barycentric)(mesh.triangles()[faces], points)`.
    """
    d = triangle.shape[-1]
    check_shape("triangle", triangle, (3, d))
    check_shape("point", point, (d,))
    a, b, c = triangle
    ab, ac, ap = b - a, c - a, point - a
    bb, bc, cc = jnp.dot(ab, ab), jnp.dot(ab, ac), jnp.dot(ac, ac)
    pb, pc = jnp.dot(ap, ab), jnp.dot(ap, ac)
    square = bb * cc - bc * bc
    solid = square > 8 * jnp.finfo(square.dtype).eps * bb * cc
    divide = lambda x: jnp.where(solid, x, 0) / jnp.where(solid, square, 1)
    u, w = divide(cc * pb - bc * pc), divide(bb * pc - bc * pb)
    inner = jnp.stack([1 - u - w, u, w])
    return jnp.where(solid, inner, _on_longest_side(triangle, point))


def _on_longest_side(triangle, point):
    to_next = jnp.roll(triangle, -1, axis=0) - triangle
    squares = jnp.sum(to_next**2, axis=-1)
    along = jnp.sum((point - triangle) * to_next, axis=-1)
    start = jnp.argmax(squares)
    share = safe_divide(along[start], squares[start])
    corner = jnp.arange(3)
    there = jnp.where(corner == (start + 1) % 3, share, 0)
    return jnp.where(corner == start, 1 - share, there)


def interpolate_normals(
    mesh: TriangleMesh,
    face: Int[Array, " q"],
    barycentric: Float[Array, "q 3"],
    *,
    normals: Float[Array, "v 3"] | None = None,
) -> Float[Array, "q 3"]:
    """The unit normals normalize(b_0 n_i + b_1 n_j + b_2 n_k) on the faces (i, j, k).

    `normals` [v, 3] are those of the mesh by default, or `vertex_normals(mesh)` where
    it has none. `face` and `barycentric` as in `interpolate`; zero where that is zero.

    Source: B. T. Phong, Illumination for computer generated pictures, 1975.
    """
    if normals is None:
        normals = vertex_normals(mesh) if mesh.normals is None else mesh.normals
    return safe_normalize(interpolate(mesh, normals, face, barycentric))
