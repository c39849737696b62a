"""Robust kernels, defined by their cost alone, and how their width is found.

A pair with squared residual r^2 costs width^2 rho(r^2 / width^2), with rho(0) = 0 and
rho'(0) = 1. The weight of the pair in a least-squares step is rho', by autodiff.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Ends at 2^-27 of the largest.
_PARTS, _DIVISIONS = 8, 9
# The median of |r| of Gaussian residuals is this share of their standard deviation.
_NORMAL_MEDIAN = 0.6745


class AbstractWidth(eqx.Module):
    """How the width of a kernel follows from the residuals."""

    @abstractmethod
    def __call__(
        self,
        squares: Float[Array, " n"],
        mask: Bool[Array, " n"],
        previous: Float[Array, ""],
    ) -> Float[Array, ""]:
        """The next width, in the unit of the residuals.

        `squares` are the squared residuals of the pairs where `mask`; `previous` is the
        width of the step before, infinite at first. Widths never grow.
        """


class FixedWidth(AbstractWidth):
    """The same width at every step, in the unit of the residuals; differentiable."""

    width: Float[Array, ""] | float

    def __call__(self, squares, mask, previous):
        return jnp.asarray(self.width, squares.dtype)


class QuantileWidth(AbstractWidth):
    """`factor` times the residual that the given share of the pairs stays below.

    Never below `least`, in the unit of the residuals.
    """

    share: float = 0.5
    factor: float = 1.0
    least: Float[Array, ""] | float = 0.0

    def __call__(self, squares, mask, previous):
        width = self.factor * quantile(squares, mask, self.share)
        return jnp.minimum(previous, jnp.maximum(width, self.least))


def deviation_width(factor: float = 4.685, least: float = 0.0) -> QuantileWidth:
    """`factor` standard deviations of the residuals, from their median.

    sigma = median |r| / 0.6745, which up to half of the pairs being wrong cannot
    spoil. 4.685 makes `Tukey` 95 % efficient for Gaussian noise.
    """
    return QuantileWidth(0.5, factor / _NORMAL_MEDIAN, least)


class AnnealedWidth(AbstractWidth):
    """From `start` medians of the first residuals, times `decay` a step, to `end`.

    `end` is in the unit of the residuals. Source: Zhang, Yao, Deng 2021, Fast and
    robust iterative closest point (start 3, decay 1/2).
    """

    end: Float[Array, ""] | float
    start: float = 3.0
    decay: float = 0.5

    def __call__(self, squares, mask, previous):
        first = self.start * quantile(squares, mask, 0.5)
        width = jnp.where(jnp.isfinite(previous), self.decay * previous, first)
        return jnp.maximum(width, self.end)


class AbstractKernel(eqx.Module):
    """A cost rho of the squared residual in units of the squared width."""

    width: eqx.AbstractVar[AbstractWidth]

    @abstractmethod
    def rho(self, s: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """The cost of s = r^2 / width^2 >= 0."""

    def weight(self, s: Float[Array, "*n"]) -> Float[Array, "*n"]:
        """rho'(s): one at zero, falling for outliers."""
        return jax.jvp(self.rho, (s,), (jnp.ones_like(s),))[1]


def _as_width(width) -> AbstractWidth:
    return width if isinstance(width, AbstractWidth) else FixedWidth(width)


class L2(AbstractKernel):
    """rho(s) = s: least squares, for pairs without outliers."""

    width: AbstractWidth = FixedWidth(1.0)

    def rho(self, s):
        return s


class Huber(AbstractKernel):
    """rho(s) = s up to 1, then 2 sqrt(s) - 1: convex; outliers keep some pull."""

    width: AbstractWidth = eqx.field(
        converter=_as_width, default=deviation_width(1.345)
    )

    def rho(self, s):
        inner = s <= 1
        return jnp.where(inner, s, 2 * jnp.sqrt(jnp.where(inner, 1, s)) - 1)


class Cauchy(AbstractKernel):
    """rho(s) = log(1 + s)."""

    width: AbstractWidth = eqx.field(
        converter=_as_width, default=deviation_width(2.385)
    )

    def rho(self, s):
        return jnp.log1p(s)


class GemanMcClure(AbstractKernel):
    """rho(s) = s / (1 + s)."""

    width: AbstractWidth = eqx.field(converter=_as_width, default=deviation_width(3.0))

    def rho(self, s):
        return s / (1 + s)


class Tukey(AbstractKernel):
    """rho(s) = (1 - (1 - s)^3) / 3 up to 1, then 1/3: beyond the width no pull."""

    width: AbstractWidth = eqx.field(converter=_as_width, default=deviation_width())

    def rho(self, s):
        # Multiplied out: as a difference it is zero below rounding, where rho / s must
        # stay near one.
        s = jnp.minimum(s, 1)
        return s * (1 - s + s**2 / 3)


class Welsch(AbstractKernel):
    """rho(s) = 1 - exp(-s)."""

    width: AbstractWidth = eqx.field(
        converter=_as_width, default=deviation_width(2.985)
    )

    def rho(self, s):
        return -jnp.expm1(-s)


class Trimmed(AbstractKernel):
    """rho(s) = min(s, 1), as wide as the residual of the best `share` of the pairs.

    The others have no pull at all: trimmed least squares (Chetverikov et al. 2005).
    """

    share: float = 0.7

    @property
    def width(self):
        return QuantileWidth(self.share)

    def rho(self, s):
        # Not the minimum, whose derivative at 1 is 1/2: the last pair counts fully.
        return jnp.where(s <= 1, s, 1)


def quantile(
    squares: Float[Array, " n"], mask: Bool[Array, " n"], share: float
) -> Float[Array, ""]:
    """The root of the square that the given share of the pairs stays at or below.

    By repeated division into parts: passes over the data are cheaper than a sort, and
    few passes cheaper than many.
    """
    wanted = share * jnp.sum(mask).astype(squares.dtype)
    top = jnp.sqrt(jnp.max(jnp.where(mask, squares, 0), initial=0))
    parts = jnp.arange(1, _PARTS, dtype=squares.dtype) / _PARTS

    def divide(_, ends):
        low, high = ends
        between = low + parts * (high - low)
        below = mask & (squares <= between[:, None] ** 2)
        enough = jnp.sum(below, axis=1).astype(squares.dtype) >= wanted
        low = jnp.max(jnp.where(enough, low, between))
        return low, jnp.min(jnp.where(enough, between, high))

    low = jnp.zeros_like(top)
    return jax.lax.fori_loop(0, _DIVISIONS, divide, (low, top))[1]
