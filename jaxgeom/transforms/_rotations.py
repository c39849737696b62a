"""The exponential map of rotations in space and its inverse.

R = exp([w]x) turns by |w| radians about the axis w (Rodrigues). Both maps have Taylor
branches at the identity, and the logarithm has its own branch near a half turn, so that
values and derivatives stay finite everywhere.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_norm


def cross_matrix(w: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """The matrix [w]x with [w]x v = w x v."""
    x, y, z = w
    o = jnp.zeros_like(x)
    return jnp.stack([o, -z, y, z, o, -x, -y, x, o]).reshape(3, 3)


def rotation_exp(w: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """The rotation by |w| radians about w: I + a [w]x + b [w]x^2, a = sin t / t,
    b = (1 - cos t) / t^2, t = |w|."""
    square = jnp.dot(w, w)
    small = square < jnp.finfo(w.dtype).eps ** 0.5
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    a = jnp.where(small, 1 - square / 6 + square**2 / 120, jnp.sin(angle) / angle)
    # 2 sin^2(t/2) instead of 1 - cos t, which cancels.
    b_large = 2 * jnp.sin(angle / 2) ** 2 / safe
    b = jnp.where(small, 0.5 - square / 24 + square**2 / 720, b_large)
    k = cross_matrix(w)
    return jnp.eye(3, dtype=w.dtype) + a * k + b * (k @ k)


def rotation_log(rotation: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """The rotation vector w, |w| <= pi, with rotation = exp([w]x).

    Goes through the unit quaternion, whose largest component is found first (Shepperd
    1978), so that no branch divides by a small number.
    """
    q = _quaternion(rotation)
    q = jnp.where(q[0] < 0, -q, q)
    vector = q[1:]
    sine = safe_norm(vector)
    half = jnp.arctan2(sine, q[0])
    small = sine < jnp.finfo(rotation.dtype).eps ** 0.5
    factor = jnp.where(small, 2 / q[0], 2 * half / jnp.where(small, 1.0, sine))
    return factor * vector


def _quaternion(r: Float[Array, "3 3"]) -> Float[Array, " 4"]:
    """The unit quaternion (w, x, y, z) of a rotation matrix."""
    xx, yy, zz = r[0, 0], r[1, 1], r[2, 2]
    squares = jnp.stack(
        [1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz]
    )
    a, b, c = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    d, e, f = r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1]
    # Row k is 4 q_k q; the row of the largest component is the well conditioned one.
    products = jnp.stack(
        [
            jnp.stack([squares[0], a, b, c]),
            jnp.stack([a, squares[1], d, e]),
            jnp.stack([b, d, squares[2], f]),
            jnp.stack([c, e, f, squares[3]]),
        ]
    )
    row = products[jnp.argmax(squares)]
    return row / jnp.sqrt(jnp.dot(row, row))
