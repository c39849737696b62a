"""How much light of the key lamp and of the sky reaches a point of a field."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


class SoftShadows(eqx.Module):
    """Shadows of the key light with soft borders.

    The light that arrives is min(1, sharpness * d / t) over the way to the lamp, d the
    distance from the surface and t that from the shaded point.

    - `sharpness`: the inverse of the lamp's apparent radius, in 1 / radians.
    - `max_steps`: evaluations of the field per point.

    Source: I. Quilez, Soft shadows in raymarched SDFs, 2010.
    """

    sharpness: float = 12.0
    max_steps: int = eqx.field(static=True, default=48)

    def light(self, field: Callable, start, direction, reach) -> Float[Array, ""]:
        """Between 0 and 1, for a ray of length `reach` from `start` [3] to the lamp."""
        first = reach / 256

        def advance(_, state):
            t, seen = state
            d = field(start + t * direction)
            arrives = jnp.where(t < reach, self.sharpness * d / t, 1)
            return t + jnp.maximum(d, first / 4), jnp.minimum(seen, arrives)

        begin = (jnp.asarray(first, start.dtype), jnp.ones((), start.dtype))
        _, seen = jax.lax.fori_loop(0, self.max_steps, advance, begin)
        return jnp.clip(seen, 0, 1)


class AmbientOcclusion(eqx.Module):
    """Less light from the sky in corners and clefts.

    1 - strength * sum_i 2^-i (h_i - f(x + h_i n)) / sum_i 2^-i h_i at `samples` heights
    h_i up to `reach` above the surface: nothing is lost where f grows like a distance.

    - `reach`: in the unit of the points; `strength`: 1 is physical, more is darker.

    Source: I. Quilez, after A. Evans, Fast approximations for global illumination on
    dynamic scenes, 2006.
    """

    reach: float = 0.2
    strength: float = 1.0
    samples: int = eqx.field(static=True, default=5)

    def light(self, field: Callable, point, normal) -> Float[Array, ""]:
        """Between 0 and 1, at `point` [3] with the outward unit `normal` [3]."""
        order = jnp.arange(1, self.samples + 1, dtype=point.dtype)
        heights = self.reach * order / self.samples
        weights = 0.5**order
        values = jax.vmap(lambda h: field(point + h * normal))(heights)
        missing = jnp.sum(weights * (heights - values)) / jnp.sum(weights * heights)
        return jnp.clip(1 - self.strength * missing, 0, 1)
