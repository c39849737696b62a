"""The rotation nearest to a matrix, with a derivative that exists wherever it should.

H = R P with P = R^T H symmetric. The derivative of R goes through the singular vectors
in the textbook, which is NaN at equal singular values, although R is smooth there. Here
it comes from the definition: dR = R W with W skew and P W + W P = R^T dH - dH^T R. The
operator on the left has the eigenvalues p_i + p_j, so that only a vanishing sum of two
of them is truly singular.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def nearest_rotation(
    matrix: Float[Array, "d d"], *, reflection: bool = False
) -> Float[Array, "d d"]:
    """The rotation R that maximises tr(R^T H): U diag(1, ..., det(U V^T)) V^T.

    With `reflection` the best orthogonal matrix U V^T, which may have determinant -1; a
    matrix that is singular to rounding still gets a rotation. Differentiable to any
    order, also at equal singular values. Where R is not unique (the two smallest
    signed singular values add up to zero) one choice is returned and the undetermined
    turns have derivative zero.

    Source: Umeyama 1991, Least-squares estimation of transformation parameters.
    """
    return polar(matrix, reflection)[0]


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def polar(matrix, reflection: bool):
    """R and the eigenvalues of P = R^T H, largest first; only the last, the one that
    pays for the sign of det R, may be negative."""
    u, p, vt = jnp.linalg.svd(matrix)
    sign = jnp.where(jnp.linalg.det(u) * jnp.linalg.det(vt) < 0, -1.0, 1.0)
    if reflection:
        # The sign of a null direction is arbitrary: it is no reason to reflect.
        flat = p[-1] <= _rounding(matrix) * p[0]
        sign = jnp.where(flat, sign, 1.0)
    flip = jnp.ones_like(p).at[-1].set(sign)
    return (u * flip) @ vt, p * flip


@polar.defjvp
def _polar_jvp(reflection, primals, tangents):
    (matrix,), (change,) = primals, tangents
    rotation, p = polar(matrix, reflection)
    turned = rotation.T @ change
    symmetric = rotation.T @ matrix
    spin = _solve_skew((symmetric + symmetric.T) / 2, turned - turned.T)
    # The spectrum only decides between cases: it is a constant.
    return (rotation, p), (rotation @ spin, jnp.zeros_like(p))


def _solve_skew(p, k):
    """The skew W with P W + W P = K, zero where the eigenvalues of P cancel.

    In the basis E_ij - E_ji the operator is a symmetric matrix ((tr P) I - P in space),
    and a plain solve with it can be differentiated again.
    """
    d = p.shape[0]
    rows, columns = np.triu_indices(d, 1)
    basis = np.zeros((len(rows), d, d))
    basis[np.arange(len(rows)), rows, columns] = 1
    basis = jnp.asarray(basis - basis.swapaxes(1, 2), p.dtype)
    operator = jnp.einsum("aij,jk,bik->ab", basis, p, basis)
    values, vectors = jnp.linalg.eigh(jax.lax.stop_gradient(operator))
    # Not the largest value: in the plane there is only one.
    size = jnp.max(jnp.abs(jax.lax.stop_gradient(p)))
    null = values <= _rounding(p) * size
    lost = jnp.where(null, vectors, 0)
    # Undetermined turns: made solvable here, taken out below.
    lift = jnp.where(size > 0, size, 1) * (lost @ lost.T)
    turn = jnp.linalg.solve(operator + lift, k[rows, columns])
    turn = turn - lost @ (lost.T @ turn)
    return jnp.einsum("a,aij->ij", turn, basis)


def _rounding(matrix):
    """The relative size below which a singular value is rounding."""
    return 16 * matrix.shape[0] * jnp.finfo(matrix.dtype).eps
