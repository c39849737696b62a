"""L-systems: words that grow by rewriting, drawn by a turtle, as bodies.

Source: P. Prusinkiewicz, A. Lindenmayer, The algorithmic beauty of plants (1990).
"""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, message
from ._field import AbstractField
from ._parameters import array, scalar
from ._smooth import UnionOfMany
from ._strokes import RoundTube


class LSystem(eqx.Module):
    """An axiom and the rules by which all its letters are rewritten at once (static).

    The turtle starts at the origin, heads along z and knows these letters, others it
    passes over:

    - `F`: a branch of one step; `f`: a step without a branch;
    - `+` `-`: turn left, right; `&` `^`: pitch down, up; `\\` `/`: roll left, right, by
      `angle` (degrees); `|`: turn about;
    - `!`: branches from here on are thinner, by `taper`; `"`: and shorter, by `shrink`;
    - `[` `]`: remember the turtle, and go back to it.
    """

    axiom: str = eqx.field(static=True)
    rules: tuple[tuple[str, str], ...] = eqx.field(static=True)
    angle: float = eqx.field(static=True, default=25.0)
    step: float = eqx.field(static=True, default=1.0)
    radius: float = eqx.field(static=True, default=0.1)
    taper: float = eqx.field(static=True, default=0.7)
    shrink: float = eqx.field(static=True, default=0.8)

    def word(self, generations: int) -> str:
        """The axiom, rewritten `generations` times."""
        rules = dict(self.rules)
        word = self.axiom
        for _ in range(generations):
            word = "".join(rules.get(letter, letter) for letter in word)
        return word

    def branches(self, generations: int) -> "Branches":
        """The body of the word after `generations` (host)."""
        drawn = _draw(self, self.word(generations))
        if not drawn:
            raise GeometryError(
                message(
                    "an L-system must draw at least one branch",
                    f"a word without F: {self.word(generations)[:40]}",
                    "Use the letter F for branches, or more generations.",
                )
            )
        return Branches(*(np.array(x) for x in zip(*drawn, strict=True)))


class Branches(AbstractField):
    """The union of tapered branches: starts and ends [n, 3], radii [n] at both.

    Exact outside, a lower bound inside; with `width`, the forks are filled (a lower
    bound, see `UnionOfMany`). O(n) for each point.
    """

    starts: Float[Array, "n 3"] = eqx.field(converter=array("starts", None, 3))
    ends: Float[Array, "n 3"] = eqx.field(converter=array("ends", None, 3))
    start_radii: Float[Array, " n"] = eqx.field(converter=array("start_radii", None))
    end_radii: Float[Array, " n"] = eqx.field(converter=array("end_radii", None))
    width: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)

    def evaluate(self, point):
        return self._union().evaluate(point)

    def claims(self):
        return self._union().claims()

    def _union(self):
        tubes = RoundTube(jnp.zeros(3), jnp.ones(3), jnp.ones(()), jnp.ones(()))
        where = lambda t: (t.start, t.end, t.start_radius, t.end_radius)
        parts = self.starts, self.ends, self.start_radii, self.end_radii
        return UnionOfMany(eqx.tree_at(where, tubes, parts), self.width)


def _draw(system: LSystem, word: str):
    """(start, end, radius, radius) of every branch of a word."""
    place, frame = np.zeros(3), np.eye(3)  # columns: heading, left, up
    frame = np.stack([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]], axis=1)
    step, radius = system.step, system.radius
    turns = _turns(math.radians(system.angle))
    kept, drawn = [], []
    for letter in word:
        if letter in "Ff":
            end = place + step * frame[:, 0]
            if letter == "F":
                drawn.append((place, end, radius, radius))
            place = end
        elif letter in turns:
            frame = frame @ turns[letter]
        elif letter == "!":
            radius = radius * system.taper
        elif letter == '"':
            step = step * system.shrink
        elif letter == "[":
            kept.append((place, frame, step, radius))
        elif letter == "]":
            place, frame, step, radius = kept.pop()
    return drawn


def _turns(angle):
    """The letters that turn the turtle, as rotations of its frame."""

    def about(axis, a):
        c, s = math.cos(a), math.sin(a)
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        turn = np.eye(3)
        turn[i, i], turn[j, j], turn[i, j], turn[j, i] = c, c, -s, s
        return turn

    pairs = {"+-": 2, "&^": 1, "\\/": 0}
    turns = {"|": about(2, math.pi)}
    for letters, axis in pairs.items():
        for letter, sign in zip(letters, (1, -1), strict=True):
            turns[letter] = about(axis, sign * angle)
    return turns


def demo_bush() -> LSystem:
    """A bush in space: three generations have 259 branches."""
    rules = (
        ("A", '[&FL!"A]/////[&FL!"A]///////[&FL!"A]'),
        ("F", "S/////F"),
        ("S", "FL"),
    )
    return LSystem("A", rules, 22.5, 0.3, 0.05, 0.75, 0.9)
