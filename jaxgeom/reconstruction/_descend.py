"""The search for a few numbers that make a function small."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from .._core import RESULTS


class Descent(eqx.Module):
    """Where a search ended; `loss` there and `first_loss` at the start.

    `result` is `not_converged` where it was cut short, `nonfinite_input` where the
    function has no value at the start.
    """

    value: Float[Array, " d"]
    loss: Float[Array, ""]
    first_loss: Float[Array, ""]
    steps: Int[Array, ""]
    result: RESULTS


def descend(
    function: Callable, start: Float[Array, " d"], *, rtol: float, max_steps: int
) -> Descent:
    """BFGS from `start`; never ends where the function is larger than there.

    `max_steps`: evaluations, at most; `rtol`: of the function and of its arguments.
    """
    found = optx.minimise(
        lambda x, _: function(x),
        optx.BFGS(rtol=rtol, atol=rtol),
        start,
        max_steps=max_steps,
        throw=False,
    )
    first, last = function(start), function(found.value)
    better = last < first
    done = found.result == optx.RESULTS.successful
    result = RESULTS.where(done, RESULTS.successful, RESULTS.not_converged)
    return Descent(
        jnp.where(better, found.value, start),
        jnp.where(better, last, first),
        first,
        found.stats["num_steps"],
        RESULTS.where(jnp.isfinite(first), result, RESULTS.nonfinite_input),
    )
