"""A tree of bounding boxes over anything small.

Groups of items near each other are its leaves, and two nodes make the next one: a
complete binary tree that needs no pointers. Node h has the children 2h and 2h + 1, and
node 1 is the root.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Tree(eqx.Module):
    """Items in the order of the leaves (sentinel n), a box per node (axes first)."""

    order: Int[Array, " m"]
    low: Float[Array, "3 h"]
    high: Float[Array, "3 h"]
    leaf: int = eqx.field(static=True)

    @property
    def first_leaf(self) -> int:
        """The node of the first leaf."""
        return self.order.shape[0] // self.leaf


def grow(
    groups: Int[Array, "g s"], low: Float[Array, "n 3"], high: Float[Array, "n 3"]
) -> Tree:
    """The tree of items in 2^m groups (see `kd_groups`), n for none; item i has the box
    from `low` to `high`."""
    corner = lambda x, fill: x.T.at[:, groups].get(mode="fill", fill_value=fill)
    # A box without items is infinitely far from everything.
    levels = [(corner(low, jnp.inf).min(axis=2), corner(high, -jnp.inf).max(axis=2))]
    while levels[-1][0].shape[1] > 1:
        low, high = levels[-1]
        levels.append(
            (
                jnp.minimum(low[:, 0::2], low[:, 1::2]),
                jnp.maximum(high[:, 0::2], high[:, 1::2]),
            )
        )
    nobody = jnp.full((3, 1), jnp.inf, levels[0][0].dtype)
    low, high = (
        jnp.concatenate([sign * nobody, *(level[i] for level in levels[::-1])], axis=1)
        for i, sign in enumerate((1, -1))
    )
    return Tree(groups.reshape(-1), low, high, groups.shape[1])


def child_boxes(tree: Tree) -> Float[Array, "h 12"]:
    """The boxes of the two children of every inner node: low, high, low, high."""
    pair = lambda x: x.reshape(3, -1, 2)
    low, high = pair(tree.low), pair(tree.high)
    sides = (low[:, :, 0], high[:, :, 0], low[:, :, 1], high[:, :, 1])
    return jnp.concatenate(sides).T


def next_node(node, trail):
    """The deepest sibling left for later, and what is left then; node 0 at the end."""
    up = jax.lax.population_count((trail & -trail) - 1)
    more = trail != 0
    up = jnp.where(more, up, 0)
    return jnp.where(more, (node >> up) ^ 1, 0), jnp.where(more, (trail >> up) ^ 1, 0)
