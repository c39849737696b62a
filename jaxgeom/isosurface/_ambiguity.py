"""Which inside corners are connected across a face where the signs do not tell.

On an ambiguous face the two inside corners are the ends of a diagonal. Both cells that
share the face must decide alike: the decision is made once, for the face.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt

from .._core import stage
from ._bits import pack


class AbstractFaceRule(eqx.Module):
    """A rule for ambiguous faces."""

    @abstractmethod
    def joined(
        self,
        values: Float[Array, "x y z"],
        level: Float[Array, ""],
        token: Bool[Array, ""] | None,
    ) -> UInt[Array, "3 x y w"] | None:
        """Bits of the faces, by normal axis and lowest node, whose inside corners
        would be connected if the face were ambiguous; None for none at all."""


class SeparateInside(AbstractFaceRule):
    """Inside corners across a diagonal stay apart, whatever the values: fastest."""

    def joined(self, values, level, token):
        return None


class AsymptoticDecider(AbstractFaceRule):
    """As the bilinear interpolant of the face: Nielson and Hamann (1991).

    The saddle of the values a, b, c, d around the face is (a c - b d) / (a + c - b - d)
    above the level; it lies inside where the product of the inside pair is larger.
    """

    def joined(self, values, level, token):
        decide = lambda v, axis: pack(_inside_saddle(v, level, axis))
        words = [
            stage(token, lambda v, a=axis: decide(v, a), values) for axis in range(3)
        ]
        return jnp.stack(words)


def _inside_saddle(values, level, axis):
    """True where the saddle of the face normal to `axis` is inside."""
    u, v = ((axis + 1) % 3, (axis + 2) % 3)
    here = values - level
    along_u, along_v = _following(here, u), _following(here, v)
    gain = here * _following(along_u, v) - along_u * along_v
    return jnp.where(here < 0, gain > 0, gain < 0)


def _following(values, axis):
    """The value at the next node along an axis; the last repeats itself."""
    n = values.shape[axis]
    index = np.minimum(np.arange(n) + 1, n - 1)
    where = (slice(None),) * axis + (index,)
    return values.at[where].get(mode="promise_in_bounds")


def ambiguous(inside_next) -> UInt[Array, "x y w"]:
    """Faces with exactly the two ends of a diagonal inside, from the words of the four
    corners in order around the face."""
    a, b, c, d = inside_next
    return (a ^ b) & (b ^ c) & (c ^ d)
