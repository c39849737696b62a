"""The exponential map of rotations of the plane and of space, and its inverse.

R = exp(K(w)) turns by |w| radians: about the axis w in space (Rodrigues), and
counterclockwise by the single number w in the plane. Both maps have Taylor branches at
the identity, and the logarithm has its own branch near a half turn, so that values and
derivatives stay finite everywhere.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import GeometryError, message, safe_norm


def skew_matrix(w: Float[Array, " r"]) -> Float[Array, "d d"]:
    """The generator K(w): [w]x with [w]x v = w x v for three numbers, and
    w [[0, -1], [1, 0]] for one."""
    if w.shape[0] == 1:
        o = jnp.zeros_like(w[0])
        return jnp.stack([o, -w[0], w[0], o]).reshape(2, 2)
    x, y, z = w
    o = jnp.zeros_like(x)
    return jnp.stack([o, -z, y, z, o, -x, -y, x, o]).reshape(3, 3)


def rotation_exp(w: Float[Array, " r"]) -> Float[Array, "d d"]:
    """The rotation by |w| radians about w: I + a K + b K^2, a = sin t / t,
    b = (1 - cos t) / t^2, t = |w|; three numbers in space, one in the plane.

    Raises `GeometryError` for other sizes.
    """
    if w.shape not in {(1,), (3,)}:
        raise GeometryError(
            message(
                "a rotation vector has three entries in space and one in the plane",
                f"shape {w.shape}",
                "Pass one vector at a time and batch with jax.vmap.",
            )
        )
    a, b, _ = _coefficients(w)
    k = skew_matrix(w)
    return jnp.eye(len(k), dtype=w.dtype) + a * k + b * (k @ k)


def left_jacobian(w: Float[Array, " r"]) -> Float[Array, "d d"]:
    """V = integral of exp(u K) over u in [0, 1] = I + b K + c K^2,
    c = (t - sin t) / t^3, with t = |w|."""
    _, b, c = _coefficients(w)
    k = skew_matrix(w)
    return jnp.eye(len(k), dtype=w.dtype) + b * k + c * (k @ k)


def _coefficients(w):
    """sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3 at t = |w|."""
    square = jnp.dot(w, w)
    small = square < jnp.finfo(w.dtype).eps ** 0.5
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    a = jnp.where(small, 1 - square / 6 + square**2 / 120, jnp.sin(angle) / angle)
    # 2 sin^2(t/2) instead of 1 - cos t, which cancels.
    b_large = 2 * jnp.sin(angle / 2) ** 2 / safe
    b = jnp.where(small, 0.5 - square / 24 + square**2 / 720, b_large)
    c_large = (angle - jnp.sin(angle)) / (safe * angle)
    c = jnp.where(small, 1 / 6 - square / 120 + square**2 / 5040, c_large)
    return a, b, c


def rotation_log(rotation: Float[Array, "d d"]) -> Float[Array, " r"]:
    """The rotation vector w, |w| <= pi, with rotation = exp(K(w)).

    In space it goes through the unit quaternion, whose largest component is found
    first (Shepperd 1978), so that no branch divides by a small number. Raises
    `GeometryError` beyond three dimensions.
    """
    if rotation.shape == (2, 2):
        return jnp.arctan2(
            rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1]
        )[None]
    if rotation.shape != (3, 3):
        raise GeometryError(
            message(
                "logarithms are for rotations of the plane and of space",
                f"shape {rotation.shape}",
                "Pass one matrix at a time and batch with jax.vmap.",
            )
        )
    q = _quaternion(rotation)
    q = jnp.where(q[0] < 0, -q, q)
    vector = q[1:]
    sine = safe_norm(vector)
    half = jnp.arctan2(sine, q[0])
    small = sine < jnp.finfo(rotation.dtype).eps ** 0.5
    # Both quotients are made safe: at a half turn q[0] is zero.
    near = 2 / jnp.where(small, q[0], 1.0)
    far = 2 * half / jnp.where(small, 1.0, sine)
    return jnp.where(small, near, far) * vector


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
