"""Large arrays that the host fills part by part, without a second copy of them."""

import math

import jax
import jax.numpy as jnp
import numpy as np

# XLA takes over memory of the host as it is if it begins at such an address.
_ALIGNMENT = 64


def host_zeros(shape: tuple[int, ...], dtype) -> np.ndarray:
    """Zeros that `from_host` can hand over; memory is taken where rows are written."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    raw = np.zeros(size + _ALIGNMENT, np.uint8)
    start = -raw.ctypes.data % _ALIGNMENT
    return raw[start : start + size].view(dtype).reshape(shape)


def from_host(array: np.ndarray) -> jax.Array:
    """The array for the device; on a CPU the same memory, not to be written again."""
    if jax.default_backend() != "cpu" or array.size == 0:
        return jnp.asarray(array)
    return jnp.from_dlpack(array)
