"""Winding number fields of points with normals, and normals that make them regular.

With dipoles mu_j = area times normal at x_j and r = x_i - x_j,

    (A mu)_i = - sum_j r . mu_j / |r|^3          4 pi times the winding number
    (G mu)_i = sum_j mu_j / |r|^3 - 3 r (r . mu_j) / |r|^5      minus its gradient

where |r| is replaced by max(|r|, width). A surface with outward dipoles has winding
number 1 inside, 0 outside, 1/2 on itself: the normals are those that make it 1/2.

Source: Lin, Shi, Liu, Fast and globally consistent normal orientation based on the
winding number normal consistency, ACM TOG 2024.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide, safe_normalize

_TILE = 128


def consistent_dipoles(
    points: Float[Array, "n 3"],
    real,
    start: Float[Array, "n 3"],
    *,
    widths: tuple[float, float],
    steps: int,
) -> Float[Array, "n 3"]:
    """Dipoles [n, 3], outward, that make the winding number 1/2 on all points.

    Steepest descent on |A mu - 1/2|^2 from `start`, the direction of each dipole
    replaced after each step by the regularised gradient; the width falls from the first
    to the last of `widths`. The cost is steps n^2.
    """
    real = real.astype(points.dtype)[:, None]
    ramp = jnp.linspace(0, 1, steps, dtype=points.dtype)
    schedule = widths[0] + ramp * (widths[1] - widths[0])
    half = jnp.full((points.shape[0], 1), 0.5, points.dtype) * real

    def step(dipoles, width):
        error = half - potential(points, points, dipoles, width)[:, None] * real
        slope = _adjoint(points, error, width) * real
        image = potential(points, points, slope, width)[:, None] * real
        rate = safe_divide(jnp.sum(slope**2), jnp.sum(image**2))
        dipoles = dipoles + rate * slope
        direction = safe_normalize(gradient(points, points, dipoles, width))
        length = jnp.linalg.norm(dipoles, axis=-1, keepdims=True)
        return direction * length * real, None

    return jax.lax.scan(step, start, schedule)[0]


def potential(targets, points, dipoles, width) -> Float[Array, " m"]:
    """A mu at targets [m, 3]."""

    def row(r, inverse):
        dot = sum(r[d] * dipoles[:, d] for d in range(3))
        return (-jnp.sum(dot * inverse**3, axis=-1),)

    return _over_pairs(row, targets, points, width)[0]


def gradient(targets, points, dipoles, width) -> Float[Array, "m 3"]:
    """G mu at targets [m, 3]: the outward direction."""

    def row(r, inverse, near):
        cube = inverse**3
        dot = sum(r[d] * dipoles[:, d] for d in range(3))
        pull = jnp.where(near, 0, 3 * dot * cube * inverse**2)
        return tuple(
            jnp.sum(dipoles[:, d] * cube - r[d] * pull, axis=-1) for d in range(3)
        )

    return jnp.stack(_over_pairs(row, targets, points, width, with_near=True), axis=-1)


def _adjoint(points, values, width):
    """A^T s."""

    def row(r, inverse):
        weight = values[:, 0] * inverse**3
        return tuple(jnp.sum(r[d] * weight, axis=-1) for d in range(3))

    # Seen from the target j, r = x_i - x_j changes sign: so does the minus of A.
    return jnp.stack(_over_pairs(row, points, points, width), axis=-1)


def _over_pairs(row, targets, points, width, with_near=False):
    """`row` of differences r (3 of [t, n]) and 1/|r|, a tile of targets at a time."""
    m = targets.shape[0]
    tiles = jnp.pad(targets, ((0, -m % _TILE), (0, 0))).reshape(-1, _TILE, 3)

    def tile(here):
        r = [here[:, d, None] - points[:, d] for d in range(3)]
        square = sum(x * x for x in r)
        near = square < width**2
        inverse = jax.lax.rsqrt(jnp.where(near, width**2, square))
        if with_near:
            return row(r, inverse, near)
        # Inside the width the kernel is zero: there neighbors only add noise.
        return row(r, jnp.where(near, 0, inverse))

    out = jax.lax.map(tile, tiles)
    return jax.tree.map(lambda x: x.reshape(-1)[:m], out)
