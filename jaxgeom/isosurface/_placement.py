"""Where along its edge a vertex lies: the root of an interpolant of the samples."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._core import safe_divide
from ._vertices import Samples

# Newton's steps double the digits; the bracket guards the first few.
_STEPS = 10


class AbstractPlacement(eqx.Module):
    """A rule that gives each vertex its parameter in [0, 1] along its cut edge."""

    @abc.abstractmethod
    def __call__(self, samples: Samples, level: Float[Array, ""]) -> Float[Array, " v"]:
        """The parameters, 0 at the lower node and 1 at the upper one."""


class Linear(AbstractPlacement):
    """The root of the line through the two ends of the edge: positions to O(h^2)."""

    def __call__(self, samples, level):
        """The parameters, 0 at the lower node and 1 at the upper one."""
        return _linear_root(samples.along(0), samples.along(1), level)


class Cubic(AbstractPlacement):
    """The root of the cubic through four samples on the line of the edge: O(h^4).

    At the sides of the grid, and beside samples that are not finite, the quadratic
    through three samples: O(h^3), or the line where there is no third. The derivative
    is that of the root (implicit function theorem).
    """

    def __call__(self, samples, level):
        """The parameters, 0 at the lower node and 1 at the upper one."""
        f0, f1 = samples.along(0), samples.along(1)
        sound = jnp.isfinite(f1 - f0)
        f0, f1 = jnp.where(sound, f0, level), jnp.where(sound, f1, level)
        cubic = _cubic(samples, f0, f1)
        fixed = lax.stop_gradient((cubic, level))
        start = lax.stop_gradient(_linear_root(f0, f1, level))
        root = _bracketed_root(*fixed, start)
        # One step of Newton from the root moves nothing but carries the derivative.
        miss = cubic.value(root) - level
        root = root - safe_divide(miss, fixed[0].slope(root))
        return jnp.where(sound, root, 0.5)


def _linear_root(f0, f1, level):
    slope = f1 - f0
    sound = (slope != 0) & jnp.isfinite(slope)
    offset = jnp.where(sound, level - f0, 0.5)
    return offset / jnp.where(sound, slope, 1.0)


class _Differences(eqx.Module):
    """A cubic in Newton's form about the nodes 0, 1 and -1."""

    start: Float[Array, " v"]
    first: Float[Array, " v"]
    second: Float[Array, " v"]
    third: Float[Array, " v"]

    def value(self, t):
        bend = self.second / 2 + (t + 1) * self.third / 6
        return self.start + t * (self.first + (t - 1) * bend)

    def slope(self, t):
        bend = (2 * t - 1) * self.second / 2 + (3 * t * t - 1) * self.third / 6
        return self.first + bend


def _cubic(samples, f0, f1) -> _Differences:
    before, has_before = samples.beyond(-1)
    after, has_after = samples.beyond(2)
    bend_before = before - 2 * f0 + f1
    bend_after = f0 - 2 * f1 + after
    one_sided = jnp.where(has_after, bend_after, 0.0)
    second = jnp.where(has_before, bend_before, one_sided)
    third = jnp.where(has_before & has_after, bend_after - bend_before, 0.0)
    return _Differences(f0, f1 - f0, second, third)


def _bracketed_root(cubic, level, start):
    """Newton's iteration, and bisection where it would leave the bracket."""
    rising = cubic.first > 0

    def step(_, state):
        t, low, high = state
        miss = cubic.value(t) - level
        past = (miss > 0) == rising
        low, high = jnp.where(past, low, t), jnp.where(past, t, high)
        following = t - safe_divide(miss, cubic.slope(t))
        inside = (following >= low) & (following <= high)
        return jnp.where(inside, following, (low + high) / 2), low, high

    t = jnp.clip(start, 0.0, 1.0)
    state = (t, jnp.zeros_like(t), jnp.ones_like(t))
    return lax.fori_loop(0, _STEPS, step, state)[0]
