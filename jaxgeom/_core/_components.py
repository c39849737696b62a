"""Connected components of a graph."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int


def components(size: int, a: Int[Array, " e"], b: Int[Array, " e"]) -> Int[Array, " n"]:
    """The least node of the connected component of each of `size` nodes.

    Links join the nodes a[i] and b[i]; those with a or b = `size` are ignored. Trees
    of labels are hooked to smaller ones and their paths halved until nothing changes:
    a logarithmic number of rounds (Shiloach and Vishkin 1982).
    """
    nodes = jnp.arange(size, dtype=jnp.int32)
    missing = (a >= size) | (b >= size)
    a, b = jnp.where(missing, 0, a), jnp.where(missing, 0, b)

    def hook(carry):
        labels, _ = carry
        at_a, at_b = labels[a], labels[b]
        low, high = jnp.minimum(at_a, at_b), jnp.maximum(at_a, at_b)
        hooked = labels.at[high].min(low)
        hooked = hooked[hooked]
        hooked = hooked[hooked]
        return hooked, jnp.any(hooked != labels)

    return jax.lax.while_loop(lambda c: c[1], hook, (nodes, jnp.asarray(True)))[0]
