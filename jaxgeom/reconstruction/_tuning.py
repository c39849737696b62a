"""The prior of a posterior, from how well it predicts points that it has not seen.

With mean m_i and deviation s_i of the vector field at held-out points, and the noise t,
minus the mean logarithm of the density of their normals n_i is, but for a constant,

    loss = mean_{i, d} ((n_id - m_id)^2 / (s_id^2 + t^2) + log(s_id^2 + t^2)) / 2,

less the logarithm of a prior of every parameter, log-normal about the value given with
a factor of e for its deviation, since long kernels of large variance fit as well as
short ones of small (Zhang, 2004, "Inconsistent estimation and asymptotically equal
interpolations in model-based geostatistics").

Points beside edges lie far outside of a Gaussian, which widens it for all others: its
central interval of 90 % then holds more, or, with few points, less. A last factor on
all variances, which leaves the mean as it is, makes the interval hold what it says.

How far the places of the points are believed is found apart: the field, 0 at points of
the surface, has the deviation (s^2 + t^2)^(1/2) at held-out ones, t the value noise,
which is the least for which the interval holds the share that it should.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.stats import norm
from jaxtyping import Array, Float, Int

from .._core import (
    RESULTS,
    GeometryError,
    failure_where,
    first_failure,
    masked_mean,
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

    - `loss`, `first_loss`: minus the mean log density of a component of a normal, with
      that of the prior, at the end (before the last factor) and at the start.
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
    rtol: float = 1e-4,
    max_steps: int = 1000,
    max_evaluations: int = 40,
) -> Tuned:
    """Length, variance and noise that make the normals of held-out points most likely.

    BFGS on their logarithms for the first `num_likely` of the points, from the values
    given, near which it stays where points say little; derivatives go through the
    linear systems. Then one factor on both deviations, so that the share `coverage` of
    the components of all held-out normals lies in the central interval of that
    probability.

    **Arguments:**

    - `cloud`, `grid`, `rtol`, `max_steps`: as in `stochastic_poisson`.
    - `held_out`: other points with normals, in no order; a few hundred. Each is a
      linear system, the first `num_likely` are one in every step of the search.
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

    points, there = _places(held_out, grid)
    normals = jnp.where(there, held_out.normals, 0)

    def errors(settings, num):
        """Of `num` normals: in units of the deviation, and the deviation."""
        mean, std = settings(cloud, grid).normals_at(points[:num])
        wide = jnp.sqrt(std**2 + settings.noise**2)
        return (normals[:num] - mean) / wide, wide

    given = [jnp.asarray(x, cloud.points.dtype) for x in (length, variance, noise)]
    start = jnp.log(jnp.stack(given))

    def loss(logarithms):
        error, wide = errors(settings_of(logarithms), num_likely)
        rows = jnp.where(there[:num_likely], error**2 / 2 + jnp.log(wide), 0)
        total = jnp.sum(rows) + jnp.sum((logarithms - start) ** 2) / 2
        count = 3 * jnp.sum(there[:num_likely])
        return safe_divide(total, count.astype(rows.dtype))

    found = descend(loss, start, rtol=_RTOL, max_steps=max_evaluations)
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


class Calibrated(eqx.Module):
    """Settings of `StochasticPoisson` whose field is as sure as it says.

    - `settings`: with the `value_noise` found.
    - `covered`: the share of held-out points within their interval, at that noise.
    - `result`: `not_converged` where the intervals are too narrow at the highest noise,
      or too wide at the lowest.
    """

    settings: StochasticPoisson
    covered: Float[Array, ""]
    result: RESULTS


def calibrate_values(
    settings: StochasticPoisson,
    cloud: PointCloud,
    grid: Grid,
    held_out: PointCloud,
    *,
    lowest: Float[Array, ""] | float | None = None,
    highest: Float[Array, ""] | float | None = None,
    coverage: float = 0.9,
    num_steps: int = 7,
) -> Calibrated:
    """The least `value_noise` whose intervals hold held-out points.

    By bisection of its logarithm, since a few wild points leave no likelihood to trust.
    What the settings say of normals stays.

    **Arguments:**

    - `settings`: kernel, variance and noise, such as those of `tune`; its own
      `value_noise` and `rtol` are not used.
    - `held_out`: other points (normals are not needed); each is a linear system in
      every one of `num_steps + 1` steps.
    - `lowest`, `highest`: a two hundredth and half of the largest spacing of the grid.
    """
    spacing = jnp.max(grid.spacing)
    low = jnp.log(spacing / 200 if lowest is None else lowest)
    high = jnp.log(spacing / 2 if highest is None else highest)
    points, there = _places(held_out, grid)
    within = norm.ppf((1 + coverage) / 2)

    def settings_of(logarithm):
        return dataclasses.replace(settings, value_noise=jnp.exp(logarithm), rtol=None)

    def covered(logarithm):
        """The share within the interval; a field that was not found is not."""
        changed = settings_of(logarithm)
        posterior = changed(cloud, grid)
        wide = jnp.sqrt(posterior.std(points) ** 2 + changed.value_noise**2)
        held = jnp.abs(jax.vmap(posterior)(points)) <= within * wide
        return masked_mean(held.astype(wide.dtype), there[:, 0])

    def halve(_, ends):
        low, high = ends
        middle = (low + high) / 2
        holds = covered(middle) >= coverage
        return jnp.where(holds, low, middle), jnp.where(holds, middle, high)

    least, most = lax.fori_loop(0, num_steps, halve, (low, high))
    found = (least > low) & (most < high)
    lost = failure_where(~found, RESULTS.not_converged)
    return Calibrated(settings_of(most), covered(most), lost)


def _places(held_out, grid):
    """Points [m, 3], those that are not there in a corner, and which are [m, 1]."""
    there = jnp.asarray(held_out.mask)[:, None]
    return jnp.where(there, held_out.points, grid.origin), there


def _check(held_out):
    if held_out.normals is None:
        raise GeometryError(
            message(
                "held-out points must have normals, which are what is predicted",
                "normals=None",
                "Set some points of the oriented cloud aside.",
            )
        )
