"""Poisson's equation on a period, by Fourier transforms."""

import jax
from jaxtyping import Array, Float

from ..linear import splat
from ..shapes import Grid
from ._kernels import Spectrum, SquaredExponential


def spectral_poisson(
    points: Float[Array, "n 3"],
    vectors: Float[Array, "n 3"],
    grid: Grid,
    *,
    smoothing: Float[Array, ""] | float = 1.0,
) -> Float[Array, "x y z"]:
    """The field [x, y, z] whose gradient is the smoothed field of vectors at points.

    Laplacian f = div (g * sum_i vectors_i delta(x - points_i)), with g a Gaussian of a
    standard deviation of `smoothing` spacings, on a grid that is one period, so leave a
    margin. Vectors that point outward, as long as the area each stands for, make it
    grow outward; it is known up to a factor, and has mean 0. Differentiable in points,
    vectors and smoothing; a vector of 0 has no influence.

    Source: S. Peng et al., Shape As Points: a differentiable Poisson solver, 2021,
    section 3.1.
    """
    q = grid.index_of(points)
    sources = jax.vmap(lambda v: splat(v, q, grid.shape), in_axes=1)(vectors)
    kernel = SquaredExponential(smoothing * grid.spacing[0])
    return Spectrum.of(kernel, 1.0, grid).field_from(sources)
