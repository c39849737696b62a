"""A preconditioner for one plus a covariance, from its largest eigenvalues.

For A symmetric and positive, r test vectors Omega (orthonormal) and Y = A Omega,

    A ~ Y (Omega^T Y)^-1 Y^T = U diag(lambda) U^T,
    M = 1 + U diag((l + 1) / (lambda + 1) - 1) U^T,    l the least of the lambda,

M (A + 1) has its eigenvalues between 1 and about l + 1 where A, smooth, has few large
ones. A shift nu of the size of rounding keeps the small matrix positive.

Frangella, Tropp and Udell (2023), "Randomized Nystrom preconditioning", algorithm 2.1.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

# Applications of the operator at one time.
_TOGETHER = 8


class Nystrom(eqx.Module):
    """r -> M r, an approximate inverse of 1 + A up to a factor.

    - `vectors`: [r, *shape] U, orthonormal rows.
    - `factors`: [r] (l + 1) / (lambda + 1), at most 1.
    """

    vectors: Float[Array, "r *shape"]
    factors: Float[Array, " r"]

    @staticmethod
    def of(operator: Callable, tests: Float[Array, "r *shape"]) -> "Nystrom":
        """From x -> A x and test vectors, random ones as a rule, at most as many as x
        has numbers. One application of A for each; constant for derivatives."""
        shape, dtype = tests.shape[1:], tests.dtype
        omega = jnp.linalg.qr(lax.stop_gradient(tests).reshape(len(tests), -1).T)[0]
        apply = lambda x: operator(x.reshape(shape)).reshape(-1)
        y = lax.stop_gradient(lax.map(apply, omega.T, batch_size=_TOGETHER)).T
        shift = jnp.finfo(dtype).eps * (1 + jnp.linalg.norm(y))
        y = y + shift * omega
        small = omega.T @ y
        size, axes = jnp.linalg.eigh((small + small.T) / 2)
        root = axes / jnp.sqrt(jnp.maximum(size, shift))
        u, s, _ = jnp.linalg.svd(y @ root, full_matrices=False)
        value = jnp.maximum(s**2 - shift, 0)
        least = jnp.min(value)
        return Nystrom(u.T.reshape(-1, *shape), (least + 1) / (value + 1))

    def __call__(self, r: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
        """M r."""
        axes = tuple(range(r.ndim))
        shared = jnp.tensordot(self.vectors, r, (tuple(a + 1 for a in axes), axes))
        return r + jnp.tensordot((self.factors - 1) * shared, self.vectors, 1)
