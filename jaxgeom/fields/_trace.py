"""Where a ray meets a field."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import safe_normalize
from ._claims import strong
from ._field import claims
from ._frozen import frozen
from ._queries import normal


class Hit(eqx.Module):
    """The first point of a ray inside a field; all finite, also where `hit` is False.

    - `point` [3], `distance` along the ray, `normal` [3] (outward, unit length);
      a ray that misses ends at `max_distance`, with normal zero.
    - `hit`: whether the surface was met; `steps`: evaluations of the field.
    """

    point: Float[Array, " 3"]
    distance: Float[Array, ""]
    normal: Float[Array, " 3"]
    hit: Bool[Array, ""]
    steps: Int[Array, ""]


def sphere_trace(
    field: Callable,
    origin: Float[Array, " 3"],
    direction: Float[Array, " 3"],
    *,
    max_steps: int = 256,
    max_distance,
    rtol: float | None = None,
    lipschitz=None,
) -> Hit:
    """The first hit of the ray origin + t direction, 0 <= t <= max_distance (ONE ray).

    Steps by f / L (Hart 1996), which never passes the surface of a field with the
    Lipschitz constant L: |f(x) - f(y)| <= L |x - y|. A ray that starts inside hits at
    t = 0; one that grazes may use up `max_steps` and then misses.

    **Arguments:**

    - `direction`: any length but zero; distances are in the unit of the points.
    - `rtol`: met when f / L <= rtol * max_distance; 32 rounding errors by default.
    - `lipschitz`: L > 0, in units of f per length; by default what the field claims,
      and 1 where it claims none (see `fields.lipschitz`).

    Differentiable with respect to field, origin and direction: dt = -df / (grad f . d).
    """
    direction = safe_normalize(direction)
    dtype = direction.dtype
    far = jnp.asarray(max_distance, dtype)
    near = far * jnp.asarray(32 * jnp.finfo(dtype).eps if rtol is None else rtol, dtype)
    ray = jax.lax.stop_gradient((origin, direction))
    steep = jax.lax.stop_gradient(slowness(field, lipschitz)).astype(dtype)
    still = frozen(field)
    slowed = lambda x: still(x) / steep
    t, f, steps = _march(slowed, ray, near, far, max_steps)
    hit = (f <= near) & (t <= far)
    t = jnp.where(hit, t + _sensitivity(field, origin, direction, t, hit), far)
    point = origin + t * direction
    unit = jnp.where(hit, normal(field, point), 0)
    return Hit(point, t, unit, hit, steps)


def slowness(field: Callable, lipschitz=None) -> Float[Array, ""]:
    """By what to divide the values of a field, so that they are safe steps.

    The given constant; or that which the field claims; or 1 where none is known.
    """
    if lipschitz is not None:
        return strong(lipschitz)
    constant = claims(field).lipschitz
    return jnp.where(jnp.isfinite(constant) & (constant > 0), constant, 1)


def _march(field, ray, near, far, max_steps):
    origin, direction = ray

    def going(state):
        t, f, steps = state
        return (f > near) & (t <= far) & (steps < max_steps)

    def advance(state):
        t, f, steps = state
        t = jnp.where(steps == 0, t, t + f)
        return t, field(origin + t * direction), steps + 1

    zero = jnp.zeros((), direction.dtype)
    return jax.lax.while_loop(going, advance, (zero, zero + jnp.inf, jnp.int32(0)))


def _sensitivity(field, origin, direction, t, hit):
    """Zero, with the derivative of the hit distance (implicit function theorem)."""
    f, gradient = jax.value_and_grad(field)(origin + t * direction)
    slope = jax.lax.stop_gradient(jnp.dot(gradient, direction))
    # A ray that leaves or grazes the surface has no such derivative.
    entering = hit & (slope < -(jnp.finfo(t.dtype).eps ** 0.5))
    change = f - jax.lax.stop_gradient(f)
    return -jnp.where(entering, change, 0) / jnp.where(entering, slope, 1)
