"""Curves and surfaces alike, as maps of unknowns within bounds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._core import safe_norm
from ._abstract import AbstractCurve, AbstractSurface
from ._domain import Interval, wrap_parameter


class Search(eqx.Module):
    """A curve or surface as a map from y [d] to space, with its intervals."""

    shape: AbstractCurve | AbstractSurface
    intervals: tuple[Interval, ...]

    @staticmethod
    def of(shape: AbstractCurve | AbstractSurface) -> "Search":
        """The map of a curve (d = 1) or a surface (d = 2)."""
        if isinstance(shape, AbstractCurve):
            return Search(shape, (shape.interval(),))
        domain = shape.domain()
        return Search(shape, (domain.u, domain.v))

    def __call__(self, y):
        return self.shape(y[0] if len(self.intervals) == 1 else y)

    def frozen(self) -> "Search":
        """The same without derivatives in its parameters: a search may loop freely."""
        stop = lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x
        return jax.tree.map(stop, self)

    def wrap(self, y):
        """y taken into the domain."""
        if len(self.intervals) == 1:
            return wrap_parameter(self.intervals[0], y[0])[None]
        return self.shape.domain().wrap(y)

    def options(self, query, y):
        """Of `BoxNewton`: the bounds that are neither seams nor poles, the rounding."""
        dtype = y.dtype
        end = lambda i, at, side: np.inf if i.periodic or i.poles[side] else at
        lower = [-end(i, -i.low, 0) for i in self.intervals]
        upper = [end(i, i.high, 1) for i in self.intervals]
        bounds = {"lower": jnp.array(lower, dtype), "upper": jnp.array(upper, dtype)}
        size = safe_norm(query) + safe_norm(self(y))
        rounding = 16 * jnp.finfo(dtype).eps * size
        lengths = jnp.array([i.length for i in self.intervals], dtype)
        still = rounding / lengths
        return {**bounds, "wrap": self.wrap, "rounding": rounding, "still": still}
