"""What every parametric curve and surface is."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import check_shape
from ..transforms import Affine, Rigid, Similarity
from ._domain import Domain, Interval


class AbstractCurve(eqx.Module):
    """A map t -> point [3] (or [d]) on an interval; its parameters are leaves.

    Call it with ONE parameter; map over many with `jax.vmap`.
    """

    @abstractmethod
    def evaluate(self, t: Float[Array, ""]) -> Float[Array, " 3"]:
        """The point at t."""

    @abstractmethod
    def interval(self) -> Interval:
        """Where t runs; static."""

    def __call__(self, t: Float[Array, ""]) -> Float[Array, " 3"]:
        """The point at t."""
        return self.evaluate(floating(t))


class AbstractSurface(eqx.Module):
    """A map (u, v) -> point [3] on a rectangle; its parameters are leaves.

    Call it with ONE pair uv [2]; map over many with `jax.vmap`. Seen from the side to
    which its normal X_u x X_v points, u turns into v counter-clockwise.
    """

    @abstractmethod
    def evaluate(self, uv: Float[Array, " 2"]) -> Float[Array, " 3"]:
        """The point at (u, v)."""

    @abstractmethod
    def domain(self) -> Domain:
        """Where u and v run; static."""

    def __call__(self, uv: Float[Array, " 2"]) -> Float[Array, " 3"]:
        """The point at uv [2]."""
        uv = floating(uv)
        check_shape("uv", uv, (2,))
        return self.evaluate(uv)


class FunctionCurve(AbstractCurve):
    """The curve of any function t [] -> point [3] on an `interval`.

    A function that is a pytree (an `equinox.Module`, a `jax.tree_util.Partial`) brings
    its parameters as leaves; any other is static.
    """

    function: Callable = eqx.field(converter=lambda f: _as_pytree(f))
    along: Interval = Interval()

    def evaluate(self, t):
        return self.function(t)

    def interval(self):
        return self.along


class FunctionSurface(AbstractSurface):
    """The surface of any function uv [2] -> point [3] on the rectangle `over`.

    A function that is a pytree (an `equinox.Module`, a `jax.tree_util.Partial`) brings
    its parameters as leaves; any other is static.
    """

    function: Callable = eqx.field(converter=lambda f: _as_pytree(f))
    over: Domain = Domain()

    def evaluate(self, uv):
        return self.function(uv)

    def domain(self):
        return self.over


class MovedCurve(AbstractCurve):
    """A curve under a transform: T(c(t))."""

    curve: AbstractCurve
    target_from_source: Rigid | Similarity | Affine

    def evaluate(self, t):
        return self.target_from_source(self.curve(t))

    def interval(self):
        return self.curve.interval()


class MovedSurface(AbstractSurface):
    """A surface under a transform: T(X(u, v)). A mirror turns the normal over."""

    surface: AbstractSurface
    target_from_source: Rigid | Similarity | Affine

    def evaluate(self, uv):
        return self.target_from_source(self.surface(uv))

    def domain(self):
        return self.surface.domain()


def floating(x) -> Float[Array, "..."]:
    """x as a strongly typed floating array, so that jit does not retrace per number."""
    x = x if hasattr(x, "dtype") else np.asarray(x, float)
    real = jnp.issubdtype(x.dtype, jnp.floating)
    return jnp.asarray(x) if real else jnp.asarray(x, float)


def sized(name: str, *shape: int | None) -> Callable:
    """A converter to floating arrays of a shape whose error names the parameter."""

    def convert(x) -> Float[Array, "..."]:
        x = floating(x)
        check_shape(name, x, shape)
        return x

    return convert


scalar = sized("a scalar parameter")
point = sized("a point", 3)


def _as_pytree(function):
    leaves = jax.tree.leaves(function)
    plain = any(leaf is function for leaf in leaves)
    return jax.tree_util.Partial(function) if plain else function
