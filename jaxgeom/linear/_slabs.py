"""Grids cut into slabs along x, one for each device, that exchange their borders.

Everything here runs inside `jax.shard_map`: `u` is the slab of this device, and only
its first and last slices travel. At the sides of the box a slab is its own neighbor,
which is the zero flux of `laplacian` and the clipping of `prolong`.
"""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ._stencils import laplacian, laplacian_diagonal
from ._transfer import coarser, finer, interleaved


class Slabs(eqx.Module):
    """The axis of the mesh of devices, and how many slabs there are."""

    axis: str = eqx.field(static=True)
    count: int = eqx.field(static=True)

    def bordered(self, u: Float[Array, "x y z"]) -> Float[Array, "x2 y z"]:
        """The slab between the last slice before it and the first after it."""
        place, last = lax.axis_index(self.axis), self.count - 1
        up = [(i, i + 1) for i in range(last)]
        down = [(i + 1, i) for i in range(last)]
        before = lax.ppermute(u[-1:], self.axis, up)
        after = lax.ppermute(u[:1], self.axis, down)
        before = jnp.where(place == 0, u[:1], before)
        after = jnp.where(place == last, u[-1:], after)
        return jnp.concatenate([before, u, after])

    def laplacian(self, u, coefficients: Float[Array, " 3"]):
        """L u, as `laplacian` of the whole grid."""
        wide = self.bordered(u)
        along_x = 2 * u - wide[2:] - wide[:-2]
        flat = coefficients.at[0].set(0)
        return coefficients[0] * along_x + laplacian(u, flat)

    def laplacian_diagonal(self, shape, coefficients: Float[Array, " 3"]):
        """The diagonal of L for a slab of this shape."""
        n = shape[0]
        node = lax.axis_index(self.axis) * n + jnp.arange(n)
        count = (node > 0).astype(coefficients.dtype) + (node < self.count * n - 1)
        rest = laplacian_diagonal(shape, coefficients.at[0].set(0))
        return coefficients[0] * count[:, None, None] + rest

    def restrict(self, u: Float[Array, "x y z"]) -> Float[Array, "i j k"]:
        """P^T u; slabs must have an even number of slices."""
        w = self.bordered(u)
        near, far = w[1:-2:2] + w[2:-1:2], w[0:-3:2] + w[3::2]
        return coarser(coarser(0.75 * near + 0.25 * far, 1), 2)

    def prolong(self, u: Float[Array, "i j k"], shape) -> Float[Array, "x y z"]:
        """P u on the slab of the finer grid of `shape`."""
        w = self.bordered(finer(interleaved(u, shape[2]), 1, shape[1]))
        even, odd = (0.75 * w[1:-1] + 0.25 * side for side in (w[:-2], w[2:]))
        return jnp.stack([even, odd], axis=1).reshape(shape)

    def dot(self, a, b) -> Float[Array, ""]:
        """The inner product over all slabs."""
        return lax.psum(jnp.vdot(a, b), self.axis)

    def gathered(self, u: Float[Array, "x y z"]) -> Float[Array, "all y z"]:
        """The whole grid, on every device: for coarse levels."""
        return lax.all_gather(u, self.axis, tiled=True)

    def own(self, u: Float[Array, "all y z"]) -> Float[Array, "x y z"]:
        """The slab of this device out of a whole grid."""
        n = u.shape[0] // self.count
        return lax.dynamic_slice_in_dim(u, lax.axis_index(self.axis) * n, n)

    def turned(self, u: Float[Array, "x y z"]) -> Float[Array, "all part z"]:
        """All slices along x, but only this device's share of y."""
        return lax.all_to_all(u, self.axis, 1, 0, tiled=True)

    def turned_back(self, u: Float[Array, "all part z"]) -> Float[Array, "x y z"]:
        """The inverse of `turned`."""
        return lax.all_to_all(u, self.axis, 0, 1, tiled=True)
