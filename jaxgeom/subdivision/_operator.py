"""A linear map of vertices with few terms per row, planned once on the host."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy import sparse

from .._core import GeometryError, message

# One term added by scattering costs about as much as four gathered side by side.
_SCATTER_COST = 4


class Band(eqx.Module):
    """Consecutive rows of an operator.

    Row i is the sum over t of weights[t, i] x[indices[t, i]]; terms of the few rows
    that have more of them than w lie apart, in `extra_rows`, `extra_indices`,
    `extra_weights` [t] (the hybrid format of Bell and Garland 2009).
    """

    indices: Int[Array, "w m"]
    weights: Float[Array, "w m"]
    extra_rows: Int[Array, " t"]
    extra_indices: Int[Array, " t"]
    extra_weights: Float[Array, " t"]


class Rows(eqx.Module):
    """A sparse matrix as bands of rows, one after another; `columns` is its width."""

    bands: tuple[Band, ...]
    columns: int = eqx.field(static=True)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return sum(band.indices.shape[1] for band in self.bands), self.columns

    def to_scipy(self) -> sparse.csr_matrix:
        """The matrix in float64 (host)."""
        return sparse.vstack([_csr(band, self.columns) for band in self.bands], "csr")


class Refinement(eqx.Module):
    """The linear map from old vertices to new ones: `S @ x` for any attribute [v, ...].

    The matrix is the product of `factors`, of which the first is applied first: one or
    two for each level. Its weights depend on the connectivity alone, so that `S @ x`
    is jitted, batched and differentiated like any matrix product; it works in the
    precision of x (integers are taken to the default float). `S @ T` applies T first.
    Many shapes are fastest as one attribute [v, b, 3]; `jax.vmap` works as well.

    Build it with `plan_subdivision`, `limit` or `curve_refinement`, or from a scipy
    matrix with `Refinement.from_scipy`.

    >>> swap = Refinement.from_scipy(sparse.csr_matrix([[0.0, 1.0], [1.0, 0.0]]))
    >>> (swap @ np.array([3.0, 4.0])).tolist(), (swap @ swap).shape
    ([4.0, 3.0], (2, 2))
    """

    factors: tuple[Rows, ...]

    @property
    def shape(self) -> tuple[int, int]:
        """(new vertices, old vertices)."""
        return self.factors[-1].shape[0], self.factors[0].columns

    def __matmul__(self, x):
        """`S @ x` [m, ...] for x [v, ...], or the composition with another operator.

        Raises `GeometryError` where the sizes do not fit.
        """
        size = x.shape[0] if len(x.shape) else 0
        if size != self.shape[1]:
            must = f"the right side of S @ x must have {self.shape[1]} rows"
            fix = "Pass the attribute of the mesh the operator was planned for."
            raise GeometryError(message(must, f"shape {tuple(x.shape)}", fix))
        if isinstance(x, Refinement):
            return Refinement(x.factors + self.factors)
        x = jnp.asarray(x)
        x = x if jnp.issubdtype(x.dtype, jnp.inexact) else x.astype(float)
        for rows in self.factors:
            x = _apply(rows, x)
        return x

    def to_scipy(self) -> sparse.csr_matrix:
        """The product of the factors [m, v] (host), exact to the stored weights."""
        product = self.factors[0].to_scipy()
        for rows in self.factors[1:]:
            product = rows.to_scipy() @ product
        return product

    def merged(self) -> "Refinement":
        """The same map as one matrix (host): one pass, but more terms in all."""
        return Refinement.from_scipy(self.to_scipy())

    @classmethod
    def from_scipy(cls, matrix) -> "Refinement":
        """The operator of any scipy sparse matrix (host)."""
        rows = Rows((band_of(matrix.tocsr()),), matrix.shape[1])
        return cls((on_device(rows),))


@jax.jit
def _apply(rows: Rows, x: Float[Array, "v ..."]) -> Float[Array, "m ..."]:
    flat = x.reshape(x.shape[0], -1)
    out = [_apply_band(band, flat) for band in rows.bands]
    return jnp.concatenate(out).reshape(-1, *x.shape[1:])


def _apply_band(band, x):
    # Gathers of whole rows, one for each term: on a CPU three times as fast as one
    # gather [m, w] and four times as fast as a segment sum.
    take = lambda indices: x.at[indices].get(mode="promise_in_bounds")
    weigh = lambda weights, indices: weights.astype(x.dtype)[:, None] * take(indices)
    out = jnp.zeros((band.indices.shape[1], x.shape[1]), x.dtype)
    for weights, indices in zip(band.weights, band.indices, strict=True):
        out = out + weigh(weights, indices)
    if band.extra_rows.shape[0]:
        extra = weigh(band.extra_weights, band.extra_indices)
        out = out.at[band.extra_rows].add(extra, mode="promise_in_bounds")
    return out


# The host side: numpy in float64 and int32; nothing below runs under jit.


def band_from_entries(rows, columns, weights, shape: tuple[int, int]) -> Band:
    """The band of a matrix given by its entries; repeated ones add up, zeros go."""
    kept = weights != 0
    entries = (weights[kept], (rows[kept], columns[kept]))
    return band_of(sparse.coo_matrix(entries, shape=shape).tocsr())


def band_of(matrix: sparse.csr_matrix) -> Band:
    """The band of a matrix in compressed rows, as wide as is cheapest."""
    m, length = matrix.shape[0], np.diff(matrix.indptr)
    width = _cheapest_width(length)
    slot = np.arange(matrix.nnz) - np.repeat(matrix.indptr[:-1], length)
    row = np.repeat(np.arange(m, dtype=np.int32), length)
    # Spare slots repeat the first term of their row with weight zero, so that a
    # vertex that is not finite only spoils the rows it belongs to.
    first = np.zeros(m, np.int32)
    full = length > 0
    first[full] = matrix.indices[matrix.indptr[:-1][full]]
    indices = np.tile(first, (width, 1))
    weights = np.zeros((width, m))
    near = slot < width
    indices[slot[near], row[near]] = matrix.indices[near]
    weights[slot[near], row[near]] = matrix.data[near]
    far = ~near
    extra = (row[far], matrix.indices[far].astype(np.int32), matrix.data[far])
    return Band(indices, weights, *extra)


def even_band(indices, weights) -> Band:
    """The band of rows of the same number of terms: both arrays are [w, m]."""
    none = np.zeros(0, np.int32)
    return Band(indices.astype(np.int32), weights, none, none, np.zeros(0))


def identity_band(start: int, stop: int) -> Band:
    """The rows that copy x[start], ..., x[stop - 1]."""
    indices = np.arange(start, stop, dtype=np.int32)[None]
    return even_band(indices, np.ones(indices.shape))


def on_device(tree):
    """The arrays of the host as JAX arrays, reals in the default precision."""
    real = jax.dtypes.canonicalize_dtype(float)
    cast = lambda x: x.astype(real if x.dtype.kind == "f" else np.int32, copy=False)
    return jax.device_put(jax.tree.map(cast, tree))


def _cheapest_width(length) -> int:
    """The width w that minimises m w + cost * (terms beyond w); at least 1."""
    rows_longer = length.size - np.cumsum(np.bincount(length, minlength=2))
    worth = np.flatnonzero(_SCATTER_COST * rows_longer > length.size)
    return int(worth[-1]) + 1 if worth.size else 1


def _csr(band, columns):
    w, m = band.indices.shape
    rows = np.concatenate([np.tile(np.arange(m), w), np.asarray(band.extra_rows)])
    flat = lambda x, extra: np.concatenate([np.asarray(x).ravel(), np.asarray(extra)])
    weights = flat(band.weights, band.extra_weights).astype(np.float64)
    indices = flat(band.indices, band.extra_indices)
    matrix = sparse.csr_matrix((weights, (rows, indices)), shape=(m, columns))
    matrix.eliminate_zeros()
    return matrix
