"""What the solution does at the sides of the box, and beyond.

Each condition says which nodes are fixed at +1/2, the value of the outside.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool


class AbstractBoundary(eqx.Module):
    """A boundary condition: the nodes whose value is known to be +1/2."""

    @abstractmethod
    def fixed(self, shape: tuple[int, int, int]) -> Bool[Array, "x y z"] | None:
        """True at nodes held at +1/2, or None where there are none."""


class Neumann(AbstractBoundary):
    """No flux through the sides: surfaces may leave the box at right angles."""

    def fixed(self, shape):
        return None


class Dirichlet(AbstractBoundary):
    """The outermost layer of nodes is outside: the surface closes within the box."""

    def fixed(self, shape):
        inner = jnp.zeros(shape, bool)
        return ~inner.at[1:-1, 1:-1, 1:-1].set(True)


class Envelope(AbstractBoundary):
    """Given nodes are outside, such as those a scanner looked through.

    `outside`: [x, y, z] booleans. The envelope constraint of Kazhdan et al. (2020),
    "Poisson surface reconstruction with envelope constraints".
    """

    outside: Bool[Array, "x y z"]

    def fixed(self, shape):
        return self.outside
