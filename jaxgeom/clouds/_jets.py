"""Curvatures of a sampled surface: a polynomial through the neighbors of every point.

In a frame of two tangents and the normal, in units of the reach h of the neighborhood,
the surface is the graph z = f(x, y). A polynomial of degree d (a jet) is fitted to the
neighbors by least squares; with a = f_x and b = f_y at the point the two forms are

    I  = [[1 + a^2, a b], [a b, 1 + b^2]],   II = -[[f_xx, f_xy], [f_xy, f_yy]] / w,

w = sqrt(1 + a^2 + b^2), positive where the surface bends away from its normal. With
I = L L^T the curvatures are the eigenvalues of L^-1 II L^-T, and an eigenvector e
belongs to the direction L^-T e in the plane of x and y. The error of a derivative of
order k is O(h^(d + 1 - k)): curvatures converge at order d - 1.
"""

import jax
import jax.numpy as jnp

from .._core import GeometryError, eigen_two, message, safe_normalize, tangents_to
from ..neighbors import AbstractBackend
from ..shapes import PointCloud, PrincipalCurvatures
from ._neighborhoods import nearest_graph

# Of the trace of the normal equations, in units of the rounding error.
_RIDGE = 8


def principal_curvatures(
    cloud: PointCloud,
    *,
    k: int = 24,
    degree: int = 3,
    backend: AbstractBackend | None = None,
) -> PrincipalCurvatures:
    """The principal curvatures and directions at every point of an oriented cloud.

    A polynomial of `degree` (2 to 4; it has 6, 10 or 15 coefficients) is fitted to the
    `k` nearest points, itself among them. On a smooth surface without noise the error
    falls with the power `degree` - 1 of the distance of the points, whatever their
    arrangement: the vertices of a mesh, with `convert.vertices_to_cloud`, need not be
    regular. Noise of size s asks for neighborhoods with s << kappa h^2.

    Zero where there are fewer neighbors than coefficients or no normal. Differentiable
    in the points and normals; which points are neighbors is constant.
    Raises `GeometryError` for a cloud without normals, a degree out of range and a `k`
    of fewer than the coefficients.

    Source: F. Cazals, M. Pouget, Estimating differential quantities using polynomial
    fitting of osculating jets, 2005.
    """
    _check(cloud, k, degree)
    clean = cloud.washed()
    points, normals = clean.points, safe_normalize(clean.normals)
    near = nearest_graph(cloud, k, backend=backend)
    there = near.mask
    gaps = jnp.asarray(points)[jnp.where(there, near.indices, 0)] - points[:, None]
    gaps = jnp.where(there[..., None], gaps, 0)
    fit = jax.vmap(lambda x, w, n: _jet(x, w, n, degree))
    values, directions, found = fit(gaps, there.astype(points.dtype), normals)
    enough = jnp.sum(there, axis=1) >= _num_coefficients(degree)
    some = enough & jnp.any(normals != 0, axis=1)
    wash = lambda x: jnp.where(some.reshape(-1, *(1,) * (x.ndim - 1)), x, 0)
    return PrincipalCurvatures(wash(values), wash(directions), wash(found))


def _jet(gaps, weights, normal, degree):
    """Curvatures, directions and the normal of the jet at the origin of `gaps`."""
    frame = jnp.concatenate([tangents_to(normal), normal[None]])
    reach = jnp.max(jnp.sum(jax.lax.stop_gradient(gaps) ** 2, axis=1)) ** 0.5
    reach = jnp.where(reach > 0, reach, 1)
    x, y, z = (gaps @ frame.T / reach).T
    powers = [(i, n - i) for n in range(degree + 1) for i in range(n, -1, -1)]
    columns = jnp.stack([x**i * y**j for i, j in powers], axis=1)
    system = columns.T @ (weights[:, None] * columns)
    ridge = _RIDGE * jnp.finfo(z.dtype).eps * jnp.trace(system)
    # Padding alone leaves no equation: any positive diagonal will do.
    ridge = jnp.where(ridge > 0, ridge, 1) * jnp.eye(len(powers), dtype=z.dtype)
    fitted = jax.scipy.linalg.solve(
        system + ridge, columns.T @ (weights * z), assume_a="pos"
    )
    # The order of `powers`: 1, x, y, x^2, x y, y^2, ...
    a, b, xx, xy, yy = fitted[1:6]
    width = jnp.sqrt(1 + a**2 + b**2)
    second = -jnp.array([[2 * xx, xy], [xy, 2 * yy]]) / (width * reach)
    first = jnp.array([[1 + a**2, a * b], [a * b, 1 + b**2]])
    root = jnp.linalg.inv(jnp.linalg.cholesky(first))
    values, turns = eigen_two(root @ second @ root.T)
    tangents = jnp.array([[1, 0, a], [0, 1, b]]) @ frame
    found = safe_normalize(jnp.stack([-a, -b, jnp.ones_like(a)])) @ frame
    return values, turns @ root @ tangents, found


def _num_coefficients(degree) -> int:
    return (degree + 1) * (degree + 2) // 2


def _check(cloud, k, degree):
    if cloud.normals is None:
        raise GeometryError(
            message(
                "curvatures need a cloud with normals: they say what bends outward",
                "normals=None",
                "Call normals.estimate and normals.orient_consistently first.",
            )
        )
    if degree not in (2, 3, 4) or k < _num_coefficients(degree):
        raise GeometryError(
            message(
                "degree must be 2, 3 or 4, and k at least its 6, 10 or 15 coefficients",
                f"degree={degree}, k={k}",
                "Use degree=3 and k=24, more for noisy points.",
            )
        )
