"""Normals from bare points: those that make the winding number regular."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_normalize
from ..clouds import bounding_box, nearest_graph
from ..linear import interpolate
from ..shapes import PointCloud
from ._estimate import estimate, local_normals
from ._orient import orient_consistently
from ._winding_grid import GridWinding, descend


class Oriented(eqx.Module):
    """A cloud with outward unit normals, and how sure they are.

    `confidence`: [n], in [0, 1], the fall of the winding number from just inside to
    just outside: 1 on a closed surface seen well, 0 where the side is not known.
    """

    cloud: PointCloud
    confidence: Float[Array, " n"]


class AbstractOrientation(eqx.Module):
    """A way to give normals to a cloud that has none."""

    @abstractmethod
    def __call__(self, cloud: PointCloud) -> PointCloud:
        """The cloud with outward unit normals, zero for padding."""


class LocalPlanes(AbstractOrientation):
    """The normals of the planes through k neighbors, by `orient_consistently`.

    Time grows with the square of `capacity`: 0.1, 0.3 and 0.9 s for 1024, 2048 and 4096
    points on two cores. More of them matter on walls thinner than about a twentieth of
    the shape.
    """

    k: int = eqx.field(static=True, default=16)
    capacity: int = eqx.field(static=True, default=4096)

    def __call__(self, cloud):
        return orient_consistently(estimate(cloud, k=self.k), capacity=self.capacity)


class WindingConsistency(AbstractOrientation):
    """Normals that make the winding number 1/2 on all points, by convolutions on grids.

    Dipoles are improved on grids of 2^-levels resolution up to `resolution` nodes a
    side, `steps` times on each, with a kernel `width` spacings wide. The cost grows
    with the grid, not with the square of the points. The normal is that of the plane
    through k neighbors, turned to the side to which the winding number falls; for `k`
    None it is the direction of this fall, which is blurred by the kernel. It starts
    from nothing: the same points give the same normals.
    Constant under differentiation.

    Source: Lin, Shi, Liu, Fast and globally consistent normal orientation based on the
    winding number normal consistency, ACM TOG 2024.
    """

    resolution: int = eqx.field(static=True, default=128)
    levels: int = eqx.field(static=True, default=3)
    steps: int = eqx.field(static=True, default=15)
    width: float = 1.0
    k: int | None = eqx.field(static=True, default=12)

    def __call__(self, cloud):
        return self.measured(cloud).cloud

    def measured(self, cloud: PointCloud) -> Oriented:
        """The cloud with normals, and the confidence of each."""
        points = jax.lax.stop_gradient(cloud.washed().points)
        box = jax.lax.stop_gradient(bounding_box(cloud))
        side = 2 * jnp.max(box.half_extents)
        unit = (points - box.center) / jnp.where(side > 0, side, 1) + 0.5
        unit = jnp.where(cloud.mask[:, None], unit, 0.5)
        # For coincident points any width serves; one that only the data decides keeps
        # the compiler from transforming the kernel itself, which takes it minutes.
        width = jnp.asarray(self.width, points.dtype)
        width = jnp.where(side > 0, width, 2 * width)
        dipoles = jnp.zeros_like(points)
        for level in reversed(range(self.levels + 1)):
            size = self.resolution // 2**level
            winding = GridWinding.of(unit, cloud.mask, size, width)
            # Dipoles are areas in squared spacings.
            dipoles = descend(winding, 4 * dipoles, self.steps)
        field = winding.field(dipoles)
        outward = safe_normalize(winding.downhill(field))
        normals = self._turned(cloud, outward)
        reach = 2 * width * normals
        inside, outside = (
            interpolate(field, winding.q + sign * reach) for sign in (-1, 1)
        )
        fall = jnp.where(cloud.mask, jnp.clip(inside - outside, 0, 1), 0)
        return Oriented(cloud.with_normals(normals), fall)

    def _turned(self, cloud, outward):
        if self.k is None:
            return outward
        planes = local_normals(cloud, nearest_graph(cloud, self.k))
        planes = jax.lax.stop_gradient(planes)
        inward = jnp.sum(planes * outward, axis=-1, keepdims=True) < 0
        return jnp.where(inward, -planes, planes)
