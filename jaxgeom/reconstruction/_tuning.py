"""The prior of a posterior, from how well it predicts points that it has not seen.

With mean m_i and deviation s_i of the vector field at held-out points, and the noise t,
minus the mean logarithm of the density of their normals n_i is, but for a constant,

    loss = mean_{i, d} ((n_id - m_id)^2 / (s_i^2 + t^2) + log(s_i^2 + t^2)) / 2.

Normals beside edges lie far outside of a Gaussian, which widens it for all others: its
central interval of 90 % then holds more, or, with few points, less. A last factor on
all variances, which leaves the mean as it is, makes the interval hold what it says.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Float, Int

from .._core import (
    RESULTS,
    GeometryError,
    failure_where,
    first_failure,
    message,
    safe_divide,
)
from ..shapes import Grid, PointCloud
from ._descend import descend
from ._kernels import Matern
from ._stochastic import StochasticPoisson

# Of the search, of the loss and of the logarithms.
_RTOL = 1e-3


class Tuned(eqx.Module):
    """Settings of `StochasticPoisson` that predict held-out normals.

    - `loss`, `first_loss`: minus the mean log density of a component of a normal, at
      the end (before the last factor) and at the start.
    - `widening`: the last factor on the deviations.
    - `result`: `not_converged` where the search was cut short (the settings are never
      worse than those at the start), `nonfinite_input` where the loss has no value.
    """

    settings: StochasticPoisson
    loss: Float[Array, ""]
    first_loss: Float[Array, ""]
    widening: Float[Array, ""]
    steps: Int[Array, ""]
    result: RESULTS


def tune(
    cloud: PointCloud,
    grid: Grid,
    held_out: PointCloud,
    *,
    length: Float[Array, ""] | float,
    variance: Float[Array, ""] | float = 1 / 3,
    noise: Float[Array, ""] | float = 0.1,
    smoothness: float = 1.5,
    coverage: float = 0.9,
    num_likely: int = 24,
    rtol: float = 1e-3,
    max_steps: int = 300,
    max_evaluations: int = 40,
) -> Tuned:
    """Length, variance and noise that make the normals of held-out points most likely.

    BFGS on their logarithms for the first `num_likely` of the points, from the values
    given; derivatives go through the linear systems. Then one factor on both
    deviations, so that the share `coverage` of the components of all held-out normals
    lies in the central interval of that probability.

    **Arguments:**

    - `cloud`, `grid`, `rtol`, `max_steps`: as in `stochastic_poisson`.
    - `held_out`: other points with normals, in no order; a few hundred. Each is a
      linear system, the first `num_likely` are two in every step of the search.
    - `length`: of the kernel `Matern(length, smoothness)`, at the start; three spacings
      of the grid are usual.

    Raises `GeometryError` for held-out points without normals.
    """
    _check(held_out)

    def settings_of(logarithms, factor=1.0):
        length, variance, noise = jnp.exp(logarithms)
        kernel = Matern(length, smoothness)
        scaled = (factor**2 * variance, factor * noise)
        return StochasticPoisson(kernel, *scaled, rtol=rtol, max_steps=max_steps)

    there = held_out.mask[:, None]
    points = jnp.where(there, held_out.points, grid.origin)
    normals = jnp.where(there, held_out.normals, 0)

    def errors(settings, num):
        """Of `num` normals: in units of the deviation, and the deviation."""
        mean, std = settings(cloud, grid).normals_at(points[:num])
        wide = jnp.sqrt(std**2 + settings.noise**2)[:, None]
        return (normals[:num] - mean) / wide, wide

    def loss(logarithms):
        error, wide = errors(settings_of(logarithms), num_likely)
        rows = jnp.where(there[:num_likely], error**2 / 2 + jnp.log(wide), 0)
        count = 3 * jnp.sum(there[:num_likely])
        return safe_divide(jnp.sum(rows), count.astype(rows.dtype))

    given = [jnp.asarray(x, cloud.points.dtype) for x in (length, variance, noise)]
    found = descend(
        loss, jnp.log(jnp.stack(given)), rtol=_RTOL, max_steps=max_evaluations
    )
    apart = jnp.abs(errors(settings_of(found.value), len(points))[0])
    apart = jnp.where(there, apart, jnp.nan)
    widening = jnp.nanquantile(apart, coverage) / norm.ppf((1 + coverage) / 2)
    blind = failure_where(~jnp.isfinite(widening), RESULTS.nonfinite_input)
    return Tuned(
        settings_of(found.value, widening),
        found.loss,
        found.first_loss,
        widening,
        found.steps,
        first_failure(blind, found.result),
    )


def _check(held_out):
    if held_out.normals is None:
        raise GeometryError(
            message(
                "held-out points must have normals, which are what is predicted",
                "normals=None",
                "Set some points of the oriented cloud aside.",
            )
        )
