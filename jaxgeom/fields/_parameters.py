"""Parameters of fields as floating arrays, so that jit does not retrace per number."""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import check_shape


def scalar(x) -> Float[Array, ""]:
    """A number as a floating array []."""
    x = _floating(x)
    check_shape("a scalar parameter", x, ())
    return x


def vector(name: str, size: int = 3) -> Callable:
    """A converter to floating arrays [size] whose error names the parameter."""
    return array(name, size)


def array(name: str, *shape: int | None) -> Callable:
    """A converter to floating arrays of a shape (None: any size)."""

    def convert(x) -> Float[Array, "..."]:
        x = _floating(x)
        check_shape(name, x, shape)
        return x

    return convert


def _floating(x):
    x = x if hasattr(x, "dtype") else np.asarray(x, float)
    floating = jnp.issubdtype(x.dtype, jnp.floating)
    return jnp.asarray(x) if floating else jnp.asarray(x, float)
