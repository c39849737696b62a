"""A least-squares solver of optimistix for one or two bounded unknowns."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from .._core import safe_divide, safe_norm

_LEAST = 1e-12
FIRST_DAMPING = 1e-3
_MOST = 1e12
_FACTOR = 10.0
# The least relative curvature for a step of its own length.
_FLAT = 1e-3
_ROUNDING = 1024


class _State(eqx.Module):
    damping: Float[Array, ""]
    done: Bool[Array, ""]


class BoxNewton(optx.AbstractLeastSquaresSolver):
    """Damped Newton steps on 1/2 |r(y)|^2 for y [d], d = 1 or 2, within bounds.

    By the full Hessian J^T J + sum r_k d^2 r_k, with the sizes of its eigenvalues (in
    units of J^T J) plus a damping, so that every step goes downhill. A coordinate at
    its bound whose slope points outwards is held (Bertsekas 1982); a step that raises
    the sum is not taken and the damping grows. The end is a step with
    |J dy| <= atol + rtol |r|, after which a Newton step would be right to the square of
    that; `closest_point` makes it.

    `options` of `optimistix.least_squares`: `lower`, `upper` [d] (infinite where there
    is no bound), `wrap`, a function that brings y back into its domain, `rounding`, the
    error of |r|, and `still` [d], the least |dr / dy| that counts.
    """

    rtol: float
    atol: float
    norm: Callable = eqx.field(static=True, default=optx.max_norm)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        return _State(jnp.asarray(FIRST_DAMPING, y.dtype), jnp.asarray(False))

    def step(self, fn, y, args, options: dict[str, Any], state, tags):
        residual = lambda x: fn(x, args)[0]
        there, damping, moved = descent(residual, y, state.damping, options)
        reach = self.atol + self.rtol * safe_norm(residual(y))
        return there, _State(damping, (moved <= reach) | (damping > _MOST)), None

    def terminate(self, fn, y, args, options, state, tags):
        return state.done, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def descent(residual: Callable, y, damping, options):
    """One damped step from y: the new y, the next damping, and the length |J dy| tried.

    y stays where it is if |r| would grow by more than `options["rounding"]`.
    """
    local = model(residual, y)
    free = is_free(local.jacobian, local.slope, y, options)
    change = _damped_step(local, free, damping)
    there = options["wrap"](y + change)
    before, after = safe_norm(local.residual), safe_norm(residual(there))
    better = after <= before + options["rounding"]
    damping = jnp.where(better, damping / _FACTOR, damping * _FACTOR)
    moved = safe_norm(local.jacobian @ change)
    return jnp.where(better, there, y), jnp.maximum(damping, _LEAST), moved


class Model(eqx.Module):
    """A residual [k], its derivatives [k, d] and the Hessian of 1/2 |r|^2 [d, d]."""

    residual: Float[Array, " k"]
    jacobian: Float[Array, "k d"]
    hessian: Float[Array, "d d"]

    @property
    def slope(self) -> Float[Array, " d"]:
        """J^T r."""
        return self.jacobian.T @ self.residual


def model(residual: Callable, y: Float[Array, " d"]) -> Model:
    """The residual at y and all that a Newton step needs."""
    # One nested pass: each order also returns the one below it.
    value = lambda x: (lambda r: (r, r))(residual(x))
    first = jax.jacfwd(value, has_aux=True)
    second, (j, r) = jax.jacfwd(
        lambda x: (lambda d: (d[0], d))(first(x)), has_aux=True
    )(y)
    return Model(r, j, j.T @ j + jnp.tensordot(r, second, 1))


def is_free(jacobian, slope, y, options) -> Bool[Array, " d"]:
    """True for coordinates that may move: not pressed to a bound, and not without
    effect, as the angle at a pole."""
    held = (y <= options["lower"]) & (slope > 0) | (y >= options["upper"]) & (slope < 0)
    return ~held & (safe_norm(jacobian, axis=0) > options["still"])


def newton_step(local: Model, slope, free) -> Float[Array, " d"]:
    """-H^-1 slope in the free coordinates; zero in directions in which H is flat."""

    def inverse(bends):
        flat = _ROUNDING * jnp.finfo(slope.dtype).eps * jnp.max(jnp.abs(bends))
        steep = jnp.abs(bends) > flat
        return jnp.where(steep, 1 / jnp.where(steep, bends, 1), 0)

    return -_applied(local, slope, free, inverse)


def _damped_step(local, free, damping):
    """Downhill also where the energy is not convex: by the sizes of the bends."""
    inverse = lambda bends: 1 / (jnp.maximum(jnp.abs(bends), _FLAT) + damping)
    return -_applied(local, local.slope, free, inverse)


def _applied(local, slope, free, inverse):
    """f(H) slope, in coordinates in which all columns of J have length one."""
    scale = jnp.where(free, safe_norm(local.jacobian, axis=0), 1)
    both = free[:, None] & free[None, :]
    eye = jnp.eye(len(scale), dtype=scale.dtype)
    scaled = jnp.where(both, local.hessian / (scale[:, None] * scale), eye)
    return _spectral(scaled, inverse) @ (jnp.where(free, slope, 0) / scale) / scale


def _spectral(h, f):
    """f of the eigenvalues of a symmetric matrix of size 1 or 2, as p 1 + q h."""
    if len(h) == 1:
        return f(h[0])[None]
    mean, half = (h[0, 0] + h[1, 1]) / 2, (h[0, 0] - h[1, 1]) / 2
    spread = safe_norm(jnp.stack([half, h[0, 1]]))
    bends = jnp.stack([mean + spread, mean - spread])
    high, low = f(bends)
    q = safe_divide(high - low, 2 * spread)
    return (high - q * bends[0]) * jnp.eye(2, dtype=h.dtype) + q * h
