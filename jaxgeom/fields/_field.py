"""What a field is, and how fields are combined.

A field maps ONE point [3] to ONE number []: negative inside, positive outside, zero on
the surface. Every field and every combination in this room has Lipschitz constant 1
when its parts have, so that |field(x)| never exceeds the distance from x to the
surface, which is what sphere tracing relies on.
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_divide
from ..transforms import Rigid, Similarity
from ._parameters import scalar, vector
from ._stretch import smallest_stretch


class AbstractField(eqx.Module):
    """A function of one point [3] whose zero set is a surface; negative inside.

    `a | b` union, `a & b` intersection, `a - b` difference, `~a` complement.
    Parameters are leaves of the pytree, so `jax.grad` reaches them; they are cast to
    the dtype of the point. Batch over points with `jax.vmap` or `value`.
    """

    @abstractmethod
    def evaluate(self, point: Float[Array, " 3"]) -> Float[Array, ""]:
        """The value at one point, with all parameters in the dtype of the point."""

    def __call__(self, point: Float[Array, " 3"]) -> Float[Array, ""]:
        """The value at one point [3]."""
        point = jnp.asarray(point)
        cast = lambda x: x.astype(point.dtype) if eqx.is_inexact_array(x) else x
        return jax.tree.map(cast, self).evaluate(point)

    def __or__(self, other: Callable) -> "Union":
        return Union(self, other)

    def __and__(self, other: Callable) -> "Intersection":
        return Intersection(self, other)

    def __sub__(self, other: Callable) -> "Difference":
        return Difference(self, other)

    def __invert__(self) -> "Complement":
        return Complement(self)

    def blend(self, other: Callable, width) -> "SmoothUnion":
        """The union with its crease filled over `width` (see `SmoothUnion`)."""
        return SmoothUnion(self, other, width)

    def offset(self, distance) -> "Offset":
        """The body grown by `distance` (shrunk where negative)."""
        return Offset(self, distance)

    def shell(self, thickness) -> "Shell":
        """The wall of `thickness` around the surface."""
        return Shell(self, thickness)

    def translate(self, shift) -> "Transformed":
        """The body moved by the vector [3]."""
        shift = vector("shift")(shift)
        return Transformed(self, Rigid(jnp.eye(3, dtype=shift.dtype), shift))

    def rotate(self, rotation: Float[Array, "3 3"]) -> "Transformed":
        """The body turned about the origin by a rotation matrix [3, 3]."""
        rotation = jnp.asarray(rotation)
        return Transformed(self, Rigid(rotation, jnp.zeros(3, rotation.dtype)))

    def scale(self, factor) -> "Transformed":
        """The body scaled about the origin by one positive factor; stays a distance."""
        factor = scalar(factor)
        eye, zero = jnp.eye(3, dtype=factor.dtype), jnp.zeros(3, factor.dtype)
        return Transformed(self, Similarity(factor, eye, zero))

    def transformed(self, world_from_field) -> "Transformed":
        """The image of the body under a `Rigid`, `Similarity` or `Affine` map."""
        return Transformed(self, world_from_field)


class Union(AbstractField):
    """min(a, b): the points of either body.

    Exact outside where both are exact distances, a lower bound inside.
    """

    first: Callable
    second: Callable

    def evaluate(self, point):
        return jnp.minimum(self.first(point), self.second(point))


class Intersection(AbstractField):
    """max(a, b): the points common to both bodies.

    Exact inside where both are exact distances, a lower bound outside.
    """

    first: Callable
    second: Callable

    def evaluate(self, point):
        return jnp.maximum(self.first(point), self.second(point))


class Difference(AbstractField):
    """max(a, -b): the points of the first body that are not in the second. A bound."""

    first: Callable
    second: Callable

    def evaluate(self, point):
        return jnp.maximum(self.first(point), -self.second(point))


class Complement(AbstractField):
    """-a: everything else. As exact as its part."""

    body: Callable

    def evaluate(self, point):
        return -self.body(point)


class SmoothUnion(AbstractField):
    """The union with its crease filled; a bound, twice continuously differentiable.

    min(a, b) - width/6 h^3 with h = max(1 - |a - b| / width, 0) (Quilez, cubic). It
    differs from the union only where |a - b| < width, by at most width/6, and keeps
    the Lipschitz constant, because its two partial derivatives are positive with sum 1.
    Width 0 is the plain union.
    """

    first: Callable
    second: Callable
    width: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        a, b = self.first(point), self.second(point)
        gap = jnp.maximum(self.width - jnp.abs(a - b), 0)
        return jnp.minimum(a, b) - self.width / 6 * safe_divide(gap, self.width) ** 3


class Offset(AbstractField):
    """a - distance: the body grown by `distance`; as exact as its part outside."""

    body: Callable
    distance: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return self.body(point) - self.distance


class Shell(AbstractField):
    """|a| - thickness/2: the wall around the surface; as exact as its part nearby."""

    body: Callable
    thickness: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return jnp.abs(self.body(point)) - self.thickness / 2


class Transformed(AbstractField):
    """s a(T^-1 x): the image of a body under T = `world_from_field`.

    As exact as its part for `Rigid` and `Similarity`. A lower bound for `Affine`: s is
    then a smooth lower estimate of how little T stretches (4 % below it at most).
    """

    body: Callable
    world_from_field: eqx.Module

    def evaluate(self, point):
        inside = self.world_from_field.inverse().points(point)
        return smallest_stretch(self.world_from_field) * self.body(inside)
