"""Keep the stages of a computation apart under XLA on the CPU.

XLA's CPU backend fuses chains of gathers and stencils into every consumer and
recomputes them there; `lax.optimization_barrier` is removed before that happens. A
conditional on a predicate that is true at run time but unknown at compile time is not
fused through, so that each stage is computed once.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool


def runtime_token() -> Bool[Array, ""]:
    """A true that the compiler cannot see: pass it to a jitted function as argument."""
    return jnp.asarray(True)


def stage(token: Bool[Array, ""] | None, function: Callable, *args):
    """`function(*args)`, materialised.

    `token` is a run-time boolean, always true, that was passed as an argument of the
    enclosing jit and is not batched (a batched conditional computes both branches).
    With None the function is called plainly: same values, sometimes slower.
    """
    if token is None:
        return function(*args)
    # Under jit the function is traced once, for its shapes and for the conditional.
    # The lambda: bound methods of modules that hold tracers have no hash.
    run = jax.jit(lambda *operands: function(*operands))
    shapes = jax.eval_shape(run, *args)

    def never(_):
        return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    return jax.lax.cond(token, lambda operands: run(*operands), never, args)
