"""How little a transform stretches: what keeps a transformed field a lower bound."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..transforms import Rigid, Similarity

_SQUARINGS = 4


def smallest_stretch(transform) -> Float[Array, ""]:
    """A number s <= |T x - T y| / |x - y| for all x, y; the largest one unless affine.

    Affine maps take 1 / |M^-1| in the Schatten norm of order 32, which is smooth where
    the spectral norm is not (equal singular values) and at most 3^(1/32) larger.
    """
    if isinstance(transform, Rigid):
        return jnp.ones((), transform.translation.dtype)
    if isinstance(transform, Similarity):
        return transform.scale
    back = transform.inverse().linear()
    gram = back.T @ back
    size = jnp.trace(gram)
    power = gram / size
    for _ in range(_SQUARINGS):
        power = power @ power
    return 1 / (jnp.sqrt(size) * jnp.trace(power) ** (0.5 / 2**_SQUARINGS))
