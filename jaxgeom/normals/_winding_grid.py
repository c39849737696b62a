"""The winding number of all points at once: dipoles shared among the nodes of a grid,
convolved by fast Fourier transforms, and read back at the points.

The kernel is that of `_winding`, smoothed by a Gaussian of standard deviation w:

    K_w(r) = r / (4 pi |r|^3) (erf(t / sqrt 2) - sqrt(2 / pi) t exp(-t^2 / 2)),
    t = |r| / w,

and lengths are in spacings of the grid. Twice as many nodes along each axis, zero
where no points are, keep the periodic images away: the sums are those of free space.
With W the trilinear weights and C the convolution, A = -W (C . W^T), and its adjoint
W C W^T is exact, because K_w is odd.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from .._core import safe_divide, safe_normalize
from ..linear import interpolate, splat

# Nodes between the points and the sides of the grid.
_MARGIN = 3


class GridWinding(eqx.Module):
    """Points at node indices q of a cube of `size` nodes, and the kernel's transform.

    - `q`: [n, 3]. `real`: [n], 0 for padding, else 1.
    - `kernel`: [3, 2 size, 2 size, size + 1], the transform of K_w.
    """

    q: Float[Array, "n 3"]
    real: Float[Array, " n"]
    kernel: Complex[Array, "3 x y z"]
    size: int = eqx.field(static=True)

    @staticmethod
    def of(unit_points, real, size: int, width: Float[Array, ""]) -> "GridWinding":
        """For points in [0, 1]^3 and a width in spacings of the grid."""
        q = _MARGIN + unit_points * (size - 1 - 2 * _MARGIN)
        return GridWinding(q, real.astype(q.dtype), _kernel(size, width), size)

    def field(self, dipoles: Float[Array, "n 3"]) -> Float[Array, "x y z"]:
        """The winding number [size, size, size] at the nodes."""
        total = 0
        for d in range(3):
            nodes = self._spread(dipoles[:, d])
            total = total - self.kernel[d] * self._transform(nodes)
        return self._back(total)

    def at_points(self, nodes: Float[Array, "x y z"]) -> Float[Array, " n"]:
        """Values of nodes read at the points; zero for padding."""
        return interpolate(nodes, self.q) * self.real

    def adjoint(self, values: Float[Array, " n"]) -> Float[Array, "n 3"]:
        """A^T applied to one value per point."""
        once = self._transform(self._spread(values))
        columns = [self.at_points(self._back(k * once)) for k in self.kernel]
        return jnp.stack(columns, axis=-1)

    def downhill(self, nodes: Float[Array, "x y z"]) -> Float[Array, "n 3"]:
        """Minus the gradient of values at nodes, by central differences, at points."""
        columns = [self.at_points(-jnp.gradient(nodes, axis=d)) for d in range(3)]
        return jnp.stack(columns, axis=-1)

    def _spread(self, weights):
        return splat(weights * self.real, self.q, (self.size,) * 3)

    def _transform(self, nodes):
        return jnp.fft.rfftn(nodes, s=(2 * self.size,) * 3)

    def _back(self, transformed):
        full = jnp.fft.irfftn(transformed, s=(2 * self.size,) * 3)
        return full[: self.size, : self.size, : self.size]


def _kernel(size, width):
    """The transform of K_w on 2 size nodes; the offset `size`, of no sign, is zero."""
    i = jnp.arange(2 * size)
    offset = jnp.where(i < size, i, i - 2 * size) * (i != size)
    offset = offset.astype(width.dtype)
    square = sum(x**2 for x in jnp.meshgrid(*[offset] * 3, indexing="ij", sparse=True))
    profile = _profile(jnp.sqrt(square), width)
    along = [offset.reshape(-1, 1, 1), offset.reshape(1, -1, 1), offset]
    return jnp.stack([jnp.fft.rfftn(profile * x) for x in along])


def _profile(r, width):
    """|K_w(r)| / r."""
    t = r / width
    near = t < 0.5
    # Near zero the two terms cancel; there the series is exact to single precision.
    t2 = jnp.where(near, t, 0) ** 2
    series = 1 / 3 - t2 * (1 / 10 - t2 * (1 / 56 - t2 * (1 / 432 - t2 / 4224)))
    far = jnp.where(near, 1, t)
    root = (2 / jnp.pi) ** 0.5
    smeared = jax.lax.erf(far / 2**0.5) - root * far * jnp.exp(-(far**2) / 2)
    return jnp.where(near, root * series, smeared / far**3) / (4 * jnp.pi * width**3)


def descend(
    winding: GridWinding, dipoles: Float[Array, "n 3"], steps: int
) -> Float[Array, "n 3"]:
    """Steps of steepest descent on |A mu - 1/2|^2, directions replaced by -grad A mu.

    As `_winding.consistent_dipoles`; three convolutions each.
    """

    def step(dipoles, _):
        before = winding.field(dipoles)
        slope = winding.adjoint(0.5 * winding.real - winding.at_points(before))
        change = winding.field(slope)
        image = winding.at_points(change)
        rate = safe_divide(jnp.sum(slope**2), jnp.sum(image**2))
        length = jnp.linalg.norm(dipoles + rate * slope, axis=-1, keepdims=True)
        return safe_normalize(winding.downhill(before + rate * change)) * length, None

    return jax.lax.scan(step, dipoles, length=steps)[0]
