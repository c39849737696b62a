"""The vector field of stochastic Poisson without a grid, and what fits fields to it.

`Vectors` is the posterior of V at given places, by dense algebra; `MeanLoss` and
`SpreadLoss` are the losses of `neural_posterior`, which derives them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve, solve_triangular
from jaxtyping import Array, Bool, Float

from .._core import safe_divide, safe_norm, safe_normalize
from ..reconstruction import AbstractKernel

# Places drawn in every step.
_DRAWN = 256


class Vectors(eqx.Module):
    """The posterior of V at places in the box, and the samples."""

    places: Float[Array, "m 3"]
    mean: Float[Array, "m 3"]
    known: Float[Array, "m n"]
    kernel: AbstractKernel
    variance: Float[Array, ""]
    points: Float[Array, "n 3"]
    real: Bool[Array, " n"]

    @staticmethod
    def of(cloud, places, kernel, variance, noise) -> "Vectors":
        """With one Cholesky factorization of T."""
        clean, real = cloud.washed(), cloud.mask
        normals = safe_normalize(clean.normals)
        real = real & (safe_norm(normals) > 0)
        both = real[:, None] & real[None, :]
        table = jnp.where(
            both, variance * _table(kernel, clean.points, clean.points), 0
        )
        table = table + jnp.diag(jnp.where(real, noise**2, 1))
        root = jnp.linalg.cholesky(table)
        across = variance * _table(kernel, places, clean.points)
        across = jnp.where(real, across, 0)
        mean = across @ cho_solve((root, True), jnp.where(real[:, None], normals, 0))
        known = solve_triangular(root, across.T, lower=True).T
        return Vectors(places, mean, known, kernel, variance, clean.points, real)

    def covariance(self, rows, columns) -> Float[Array, "b c"]:
        """s(x, x') of places by their numbers."""
        prior = _table(self.kernel, self.places[rows], self.places[columns])
        return self.variance * prior - self.known[rows] @ self.known[columns].T


def _table(kernel, a, b):
    gaps = a[:, None] - b[None]
    return kernel.covariance(jnp.sum(gaps**2, axis=-1))


def _pulled(values, real):
    """The mean square at the samples."""
    square = jnp.where(real, values**2, 0)
    return safe_divide(jnp.sum(square), jnp.sum(real))


class MeanLoss(eqx.Module):
    """E |grad mu - m|^2 + screening mean mu(p)^2."""

    screening: Float[Array, ""]

    def __call__(self, field, data: Vectors, key):
        """The loss of a field, estimated with `key`."""
        rows = jax.random.randint(key, (_DRAWN,), 0, len(data.places))
        slopes = jax.vmap(jax.grad(field))(data.places[rows])
        fit = jnp.mean(jnp.sum((slopes - data.mean[rows]) ** 2, axis=1))
        return fit + self.screening * _pulled(jax.vmap(field)(data.points), data.real)


class SpreadLoss(eqx.Module):
    """E |J J'^T - s I|^2 / v^2 + screening mean |phi(p)|^2 / v."""

    screening: Float[Array, ""]

    def __call__(self, spread, data: Vectors, key):
        """The loss of phi, estimated with `key`."""
        rows = jax.vmap(spread)(data.points)
        pull = _pulled(safe_norm(rows), data.real) / data.variance
        return self.fit(spread, data, key)[0] + self.screening * pull

    def fit(self, spread, data, key):
        """E |J J'^T - s I|^2 / v^2 and E |s I|^2 / v^2, from all pairs of two draws."""
        keys = jax.random.split(key)
        draw = lambda k: jax.random.randint(k, (_DRAWN,), 0, len(data.places))
        rows, columns = map(draw, keys)
        jacobian = jax.vmap(jax.jacfwd(spread))
        first, second = (jacobian(data.places[i]) for i in (rows, columns))
        # |G - s I|^2 = |G|^2 - 2 s trace G + 3 s^2, without the 9 entries of every G.
        flat = lambda x: x.transpose(0, 2, 1).reshape(-1, x.shape[1])
        products = flat(first) @ flat(second).T
        wanted = data.covariance(rows, columns)
        trace = jnp.einsum("bri,cri->bc", first, second)
        nothing = jnp.mean(3 * wanted**2)
        whole = nothing + jnp.sum(products**2) / _DRAWN**2
        fit = whole - 2 * jnp.mean(wanted * trace)
        return fit / data.variance**2, nothing / data.variance**2
