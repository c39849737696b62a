"""Eigenvectors of many symmetric 3 x 3 matrices at once, by Jacobi's rotations.

Elementwise over the matrices, and so several times faster than a LAPACK call for each;
small eigenvalues keep their digits.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Convergence is quadratic: so many sweeps reach single and double precision.
_SWEEPS = {32: 4, 64: 6}
_PAIRS = ((0, 1), (0, 2), (1, 2))


def frames(
    matrix: Float[Array, "*n 3 3"],
) -> tuple[Float[Array, "*n 3"], Float[Array, "*n 3 3"]]:
    """Eigenvalues, ascending, and unit eigenvectors in the columns."""
    entries = [[matrix[..., i, j] for j in range(3)] for i in range(3)]
    one, zero = jnp.ones_like(entries[0][0]), jnp.zeros_like(entries[0][0])
    vectors = [[one if i == j else zero for i in range(3)] for j in range(3)]
    sweeps = _SWEEPS[jnp.finfo(one.dtype).bits]
    entries, vectors = jax.lax.fori_loop(0, sweeps, _sweep, (entries, vectors))
    values = [entries[i][i] for i in range(3)]
    for p, q in ((0, 1), (1, 2), (0, 1)):
        swap = values[q] < values[p]
        exchange = lambda a, b, swap=swap: (
            jnp.where(swap, b, a),
            jnp.where(swap, a, b),
        )
        values[p], values[q] = exchange(values[p], values[q])
        pairs = [exchange(*pair) for pair in zip(vectors[p], vectors[q], strict=True)]
        vectors[p], vectors[q] = map(list, zip(*pairs, strict=True))
    columns = [jnp.stack(column, axis=-1) for column in vectors]
    return jnp.stack(values, axis=-1), jnp.stack(columns, axis=-1)


def _sweep(_, carry):
    """Every off-diagonal entry turned to zero once; `vectors` are columns."""
    entries, vectors = ([list(row) for row in rows] for rows in carry)
    for p, q in _PAIRS:
        other = 3 - p - q
        tangent = _tangent(entries[p][p], entries[q][q], entries[p][q])
        c = 1 / jnp.sqrt(tangent**2 + 1)
        turn = lambda a, b, c=c, s=tangent * c: (c * a - s * b, s * a + c * b)
        change = tangent * entries[p][q]
        entries[p][p], entries[q][q] = entries[p][p] - change, entries[q][q] + change
        two = turn(entries[other][p], entries[other][q])
        entries[other][p], entries[other][q] = two
        entries[p][other], entries[q][other] = two
        entries[p][q] = entries[q][p] = jnp.zeros_like(c)
        pairs = [turn(*pair) for pair in zip(vectors[p], vectors[q], strict=True)]
        vectors[p], vectors[q] = map(list, zip(*pairs, strict=True))
    return entries, vectors


def _tangent(first, last, across):
    """The tangent of the smaller angle that turns `across` to zero."""
    some = across != 0
    ratio = (last - first) / (2 * jnp.where(some, across, 1))
    # The root of 1 + ratio^2 that cannot overflow.
    root = jnp.hypot(ratio, 1)
    sign = jnp.where(ratio < 0, -1, 1).astype(ratio.dtype)
    return jnp.where(some, sign / (jnp.abs(ratio) + root), 0)
