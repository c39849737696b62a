"""What a field is.

A field maps ONE point [3] to ONE number []: negative inside, positive outside, zero on
the surface. What else may be relied upon is in its `claims`: a Lipschitz constant L
(|f(x)| / L never exceeds the distance from x to the surface, which is what sphere
tracing and pruning rely on), how exact it is, and a box around it. Combinations derive
theirs from those of their parts.
"""

import math
from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import GeometryError, message
from ..transforms import Rigid, Similarity
from ._claims import LOWER_BOUND, Bounds, Claims, Exactness
from ._parameters import scalar, vector


class AbstractField(eqx.Module):
    """A function of one point [3] whose zero set is a surface; negative inside.

    `a | b` union, `a & b` intersection, `a - b` difference, `a ^ b` what lies in one
    of both, `~a` complement. Parameters are leaves of the pytree, so `jax.grad` reaches
    them; they are cast to the dtype of the point. Batch over points with `jax.vmap` or
    `value`. Fields of the plane map points [2] and combine in the same way.
    """

    @abstractmethod
    def evaluate(self, point: Float[Array, " 3"]) -> Float[Array, ""]:
        """The value at one point, with all parameters in the dtype of the point."""

    @abstractmethod
    def claims(self) -> Claims:
        """Lipschitz constant, exactness and bounds, from the parameters."""

    def __call__(self, point: Float[Array, " 3"]) -> Float[Array, ""]:
        """The value at one point [3]."""
        point = jnp.asarray(point)
        cast = lambda x: x.astype(point.dtype) if eqx.is_inexact_array(x) else x
        return jax.tree.map(cast, self).evaluate(point)

    @property
    def dimension(self) -> int:
        """2 for a field of the plane, 3 for one of space."""
        return self.claims().dimension

    def __or__(self, other: Callable) -> "AbstractField":
        return _room().Union(self, other)

    def __and__(self, other: Callable) -> "AbstractField":
        return _room().Intersection(self, other)

    def __sub__(self, other: Callable) -> "AbstractField":
        return _room().Difference(self, other)

    def __xor__(self, other: Callable) -> "AbstractField":
        return _room().Xor(self, other)

    def __invert__(self) -> "AbstractField":
        return _room().Complement(self)

    def blend(self, other: Callable, width) -> "AbstractField":
        """The union with its crease filled over `width` (see `SmoothUnion`)."""
        return _room().SmoothUnion(self, other, width)

    def offset(self, distance) -> "AbstractField":
        """The body grown by `distance` (shrunk where negative)."""
        return _room().Offset(self, distance)

    def shell(self, thickness) -> "AbstractField":
        """The wall of `thickness` around the surface."""
        return _room().Shell(self, thickness)

    def elongate(self, half_extents) -> "AbstractField":
        """The body cut at its middle planes and pulled apart by 2 half_extents [3]."""
        return _room().Elongated(self, half_extents)

    def twist(self, rate) -> "AbstractField":
        """The body turned about z by `rate` radians per unit of height."""
        return _room().Twisted(self, rate)

    def bend(self, rate) -> "AbstractField":
        """The body's x-axis laid on a circle of radius 1 / rate."""
        return _room().Bent(self, rate)

    def taper(self, bottom, top) -> "AbstractField":
        """The body's sections scaled by a factor from `bottom` to `top` along z."""
        return _room().Tapered(self, bottom, top)

    def displace(self, displacement: Callable, amplitude) -> "AbstractField":
        """The sum with another function, whose size is at most `amplitude`."""
        return _room().Displaced(self, displacement, amplitude)

    def morph(self, other: Callable, t) -> "AbstractField":
        """(1 - t) of this and t of the other."""
        return _room().Morphed(self, other, t)

    def mirror(self, normal, offset=0.0) -> "AbstractField":
        """The body and its image in the plane normal . x = offset |normal|."""
        return _room().Mirrored(self, normal, offset)

    def repeat(self, spacing, counts=(None, None, None)) -> "AbstractField":
        """Copies at the multiples of `spacing` [3]; `counts` None: without end."""
        return _room().Repeated(self, spacing, counts)

    def repeat_around(self, count: int) -> "AbstractField":
        """`count` copies turned about the z-axis."""
        return _room().PolarRepeated(self, count)

    def smooth_and(self, other: Callable, width) -> "AbstractField":
        """The intersection with its edge rounded off over `width`."""
        return _room().SmoothIntersection(self, other, width)

    def smooth_sub(self, other: Callable, width) -> "AbstractField":
        """The difference with its edge rounded off over `width`."""
        room = _room()
        return room.SmoothIntersection(self, room.Complement(other), width)

    def rounded(self, radius) -> "AbstractField":
        """The body grown by radius >= 0, its edges rounded; stays exact outside."""
        return _room().Rounded(self, radius)

    def extrude(self, half_height) -> "AbstractField":
        """A shape of the plane, thickened to |z| <= half_height."""
        return _room().Extruded(self, half_height)

    def revolve(self, offset=0.0) -> "AbstractField":
        """A shape of the plane, moved outwards by `offset` and turned about z."""
        return _room().Revolved(self, offset)

    def translate(self, shift) -> "AbstractField":
        """The body moved by the vector [3]."""
        shift = vector("shift", self.dimension)(shift)
        eye = jnp.eye(self.dimension, dtype=shift.dtype)
        return self.transformed(Rigid(eye, shift))

    def rotate(self, rotation: Float[Array, "3 3"]) -> "AbstractField":
        """The body turned about the origin by a rotation matrix [3, 3].

        Raises `GeometryError` for other shapes, such as a rotation vector [3].
        """
        rotation = jnp.asarray(rotation)
        if rotation.shape != (self.dimension, self.dimension):
            raise GeometryError(
                message(
                    f"rotation must be a matrix {(self.dimension, self.dimension)}",
                    f"shape {rotation.shape}",
                    "transforms.rotation_exp makes one of a rotation vector.",
                )
            )
        still = jnp.zeros(rotation.shape[0], rotation.dtype)
        return self.transformed(Rigid(rotation, still))

    def scale(self, factor) -> "AbstractField":
        """The body scaled about the origin by one positive factor; stays a distance."""
        factor = scalar(factor)
        still = Rigid.identity(factor.dtype, dimension=self.dimension)
        return self.transformed(Similarity(factor, still.rotation, still.translation))

    def transformed(self, world_from_field) -> "AbstractField":
        """The image of the body under a `Rigid`, `Similarity` or `Affine` map."""
        return _room().Transformed(self, world_from_field)


class Declared(AbstractField):
    """A function point -> number as a field, with the promises its author makes.

    Made by `declare`. `check_field` tells whether the promises hold.
    """

    function: Callable
    promise: Claims

    def evaluate(self, point):
        return self.function(point)

    def claims(self):
        return self.promise


def declare(
    function: Callable,
    *,
    lipschitz: float = math.nan,
    low=None,
    high=None,
    exactness: Exactness = LOWER_BOUND,
) -> Declared:
    """A function point -> number as a field that promises what is given here.

    **Arguments:**

    - `lipschitz`: L with |f(x) - f(y)| <= L |x - y|; NaN if you do not know.
    - `low`, `high`: [3] each, the corners of a box around the body.
    - `exactness`: `DISTANCE`, `LOWER_BOUND` (all that L says by itself) or
      `IMPLICIT_ONLY`.
    """
    space = Bounds.everywhere()
    box = Bounds.of(
        space.low if low is None else vector("low")(low),
        space.high if high is None else vector("high")(high),
        0.0,
    )
    promise = Claims(jnp.asarray(lipschitz, float), exactness, box, space)
    # A plain function is no array: as a Partial it is part of the pytree's structure.
    known = isinstance(function, eqx.Module)
    return Declared(function if known else jax.tree_util.Partial(function), promise)


def claims(field: Callable, *, dimension: int = 3) -> Claims:
    """What a field promises; for any other callable `Claims.unknown()`.

    Unknown means: Lipschitz constant NaN, implicit only, bounds infinite. See `declare`
    for how to say more about a function.
    """
    known = isinstance(field, AbstractField)
    return field.claims() if known else Claims.unknown(dimension)


def lipschitz(field: Callable) -> Float[Array, ""]:
    """L with |f(x) - f(y)| <= L |x - y|; NaN if unknown, infinite if there is none."""
    return claims(field).lipschitz


def exactness(field: Callable) -> Exactness:
    """What the values of a field say about distances, outside and inside."""
    return claims(field).exactness


def bounding_box(field: Callable) -> Bounds:
    """A box around the surface of a field, with infinite ends where none is known."""
    return claims(field).bounds


def claims_of_all(*fields: Callable) -> list[Claims]:
    """The claims of fields of the same space, some of them perhaps plain callables."""
    sizes = [f.dimension for f in fields if isinstance(f, AbstractField)]
    return [claims(f, dimension=sizes[0] if sizes else 3) for f in fields]


def _room():
    """The room itself, imported late: its nodes are made of the class above."""
    from .. import fields

    return fields
