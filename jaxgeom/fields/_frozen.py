"""Fields without derivatives, for searches that are differentiated implicitly."""

from collections.abc import Callable

import equinox as eqx
import jax


def frozen(field: Callable) -> Callable:
    """The field with `stop_gradient` on its arrays: a search may then loop freely."""
    stop = lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x
    return jax.tree.map(stop, field)
