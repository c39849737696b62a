"""Fields from meshes and from learned or sampled occupancies."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..neighbors import signed_distance
from ..shapes import TriangleMesh
from ._claims import IMPLICIT_ONLY, Bounds, Claims
from ._field import AbstractField, claims
from ._parameters import scalar


class MeshDistance(AbstractField):
    """The signed distance of a closed triangle mesh. Exact distance.

    O(number of faces) for each point; sample it on a grid for many (`sample`,
    `Sampled`). On an open mesh the sign tells the side of the nearest face only. See
    `neighbors.signed_distance`.
    """

    mesh: TriangleMesh

    def evaluate(self, point):
        return signed_distance(self.mesh, point[None]).distances[0]

    def claims(self):
        real = self.mesh.vertex_mask[:, None]
        vertices = self.mesh.vertices
        low = jnp.min(jnp.where(real, vertices, jnp.inf), axis=0)
        high = jnp.max(jnp.where(real, vertices, -jnp.inf), axis=0)
        return Claims.distance(Bounds.of(low, high))


class Occupancy(AbstractField):
    """level - occupancy(x): the body where a function into [0, 1] is above a level.

    Implicit only. Its Lipschitz constant is that of the function, NaN if not known.
    """

    occupancy: Callable
    level: Float[Array, ""] = eqx.field(converter=scalar, default=0.5)

    def evaluate(self, point):
        return self.level - self.occupancy(point)

    def claims(self):
        part, space = claims(self.occupancy), Bounds.everywhere()
        return Claims(part.lipschitz, IMPLICIT_ONLY, space, space)


class SoftOccupancy(AbstractField):
    """1 / (1 + exp(f(x) / width)): how much a point is inside, 1/2 on the surface.

    A smooth step, for losses on inside and outside; `Occupancy` turns it back into a
    field. Not a field of a body itself: it is positive everywhere. Its Lipschitz
    constant is that of f over 4 width.
    """

    body: Callable
    width: Float[Array, ""] = eqx.field(converter=scalar)

    def evaluate(self, point):
        return 0.5 - 0.5 * jnp.tanh(self.body(point) / (2 * self.width))

    def claims(self):
        part = claims(self.body)
        space = Bounds.everywhere(part.dimension)
        return Claims(part.lipschitz / (4 * self.width), IMPLICIT_ONLY, space, space)
