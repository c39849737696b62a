"""Explicit sparse matrices: rows, columns and values."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core import check_shape


class SparseOperator(eqx.Module):
    """The matrix A with A[rows[i], columns[i]] += values[i].

    `L @ x` for x [n] or [n, ...], `L.T`, `L.diagonal()`, `L.to_scipy()`, `L.dense()`.
    Differentiable in `values` and x. Entries with row m or column n, one past the last,
    are padding.
    """

    rows: Int[Array, " i"]
    columns: Int[Array, " i"]
    values: Float[Array, " i"]
    shape: tuple[int, int] = eqx.field(static=True)

    def __matmul__(self, x: Float[Array, "n *d"]) -> Float[Array, "m *d"]:
        m, n = self.shape
        check_shape("the vector", x, (n, *x.shape[1:]))
        taken = jnp.asarray(x).at[self.columns].get(mode="fill", fill_value=0)
        values = self.values.reshape(-1, *[1] * (x.ndim - 1))
        dtype = jnp.result_type(values, taken)
        out = jnp.zeros((m, *x.shape[1:]), dtype)
        return out.at[self.rows].add(values * taken, mode="drop")

    @property
    def T(self) -> "SparseOperator":
        """The transpose."""
        return SparseOperator(self.columns, self.rows, self.values, self.shape[::-1])

    def diagonal(self) -> Float[Array, " m"]:
        """A_ii of every row i."""
        m, n = self.shape
        own = (self.rows == self.columns) & (self.columns < n)
        out = jnp.zeros(m, self.values.dtype)
        return out.at[self.rows].add(jnp.where(own, self.values, 0), mode="drop")

    def dense(self) -> Float[Array, "m n"]:
        """All entries, for small matrices."""
        out = jnp.zeros(self.shape, self.values.dtype)
        return out.at[self.rows, self.columns].add(self.values, mode="drop")

    def to_scipy(self):
        """The matrix as a `scipy.sparse.csr_array`, padding left out (host)."""
        import scipy.sparse

        rows, columns, values = map(np.asarray, (self.rows, self.columns, self.values))
        real = (rows < self.shape[0]) & (columns < self.shape[1])
        entries = (values[real], (rows[real], columns[real]))
        return scipy.sparse.coo_array(entries, shape=self.shape).tocsr()
