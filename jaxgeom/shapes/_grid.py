"""Node-centred axis-aligned lattices."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import GeometryError, check_shape, message
from ._cloud import PointCloud


class Grid(eqx.Module):
    """The lattice of nodes origin + spacing * (i, j, k).

    **Arguments:**

    - `origin`: [3], the first node, in the unit of the points.
    - `spacing`: [3], the distance of neighboring nodes along each axis, positive.
    - `shape`: (x, y, z), the number of nodes along each axis, at least 2. Static.
    """

    origin: Float[Array, " 3"]
    spacing: Float[Array, " 3"]
    shape: tuple[int, int, int] = eqx.field(static=True)

    def __check_init__(self):
        check_shape("origin", self.origin, (3,))
        check_shape("spacing", self.spacing, (3,))
        if len(self.shape) != 3 or min(self.shape) < 2:
            raise GeometryError(
                message(
                    "a grid needs at least 2 nodes along each of its 3 axes",
                    f"shape {self.shape}",
                    "Pass shape=(x, y, z).",
                )
            )

    @staticmethod
    def around(cloud: PointCloud, *, resolution: int, padding: float = 0.1) -> "Grid":
        """The cube of resolution^3 nodes whose cells hold the cloud.

        The cube is 1 + `padding` times as wide as the longest side of the bounding
        box of the real points, with the same center. Each node is the center of a cell
        of width side / resolution. A cloud without extent gets a side of 1.
        """
        real = cloud.mask[:, None]
        low = jnp.min(jnp.where(real, cloud.points, jnp.inf), axis=0)
        high = jnp.max(jnp.where(real, cloud.points, -jnp.inf), axis=0)
        some = jnp.any(cloud.mask)
        low, high = jnp.where(some, low, 0.0), jnp.where(some, high, 0.0)
        extent = jnp.max(high - low)
        side = jnp.where(extent > 0, extent, 1.0) * (1 + padding)
        spacing = jnp.broadcast_to(side / resolution, (3,))
        origin = (low + high) / 2 - side / 2 + spacing / 2
        return Grid(origin, spacing, (resolution,) * 3)

    def coarser(self) -> "Grid":
        """The grid of twice the spacing; node c lies between nodes 2c and 2c + 1."""
        shape = tuple(max(-(-n // 2), 2) for n in self.shape)
        return Grid(self.origin + self.spacing / 2, 2 * self.spacing, shape)

    def nodes(self) -> Float[Array, "x y z 3"]:
        """The positions of all nodes."""
        axes = [
            self.origin[d] + self.spacing[d] * jnp.arange(n, dtype=self.origin.dtype)
            for d, n in enumerate(self.shape)
        ]
        return jnp.stack(jnp.meshgrid(*axes, indexing="ij"), axis=-1)

    def index_of(self, points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
        """The (fractional) node indices of points."""
        return (points - self.origin) / self.spacing

    def holds(self, points: Float[Array, "*n 3"]) -> Bool[Array, "*n"]:
        """Whether points lie between the first and the last nodes, these included."""
        q = self.index_of(points)
        return jnp.all((q >= 0) & (q <= jnp.asarray(self.shape) - 1), axis=-1)
