"""Pinhole cameras: the rays of a picture, and the pixels of points."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._core import safe_norm, safe_normalize
from ._parameters import scalar, vector


class Camera(eqx.Module):
    """A pinhole camera at `position` [3] that looks at `target` [3].

    - `up` [3]: what is up in the picture; not along the line of sight.
    - `field_of_view`: the angle from the lower to the upper border, in degrees.
    """

    position: Float[Array, " 3"] = eqx.field(converter=vector("position"))
    target: Float[Array, " 3"] = eqx.field(
        converter=vector("target"), default=(0.0, 0.0, 0.0)
    )
    up: Float[Array, " 3"] = eqx.field(converter=vector("up"), default=(0.0, 0.0, 1.0))
    field_of_view: Float[Array, ""] = eqx.field(converter=scalar, default=35.0)

    @staticmethod
    def around(
        points: Float[Array, "n 3"],
        *,
        azimuth: float = -60.0,
        elevation: float = 20.0,
        field_of_view: float = 35.0,
    ) -> "Camera":
        """The camera that sees all points in a square picture, up = z.

        Azimuth is counted from x towards y and elevation from the plane z = 0, in
        degrees.
        """
        points = jnp.asarray(points)
        low, high = jnp.min(points, axis=0), jnp.max(points, axis=0)
        center = (low + high) / 2
        reach = jnp.max(safe_norm(points - center))
        a, e, half = jnp.deg2rad(jnp.asarray([azimuth, elevation, field_of_view / 2]))
        side = jnp.stack([jnp.cos(a) * jnp.cos(e), jnp.sin(a) * jnp.cos(e), jnp.sin(e)])
        distance = reach / jnp.sin(half)
        return Camera(center + distance * side, center, (0.0, 0.0, 1.0), field_of_view)

    def axes(self) -> Float[Array, "3 3"]:
        """The unit vectors to the right, up and forward, as rows."""
        forward = safe_normalize(self.target - self.position)
        right = safe_normalize(jnp.cross(forward, self.up))
        return jnp.stack([right, jnp.cross(right, forward), forward])

    def focal(self, height: int) -> Float[Array, ""]:
        """The distance of the picture plane in pixels."""
        return height / 2 / jnp.tan(jnp.deg2rad(self.field_of_view) / 2)

    def directions(self, size: tuple[int, int]) -> Float[Array, "h w 3"]:
        """The unit directions of the rays through the pixel centers; row 0 is above."""
        height, width = size
        dtype = self.position.dtype
        row, column = jnp.meshgrid(
            jnp.arange(height, dtype=dtype),
            jnp.arange(width, dtype=dtype),
            indexing="ij",
        )
        x, y = column - (width - 1) / 2, (height - 1) / 2 - row
        ahead = jnp.broadcast_to(self.focal(height), x.shape)
        return safe_normalize(jnp.stack([x, y, ahead], axis=-1) @ self.axes())

    def pixels(
        self, points: Float[Array, "*n 3"], size: tuple[int, int]
    ) -> Float[Array, "*n 3"]:
        """(column, row, depth) of points; pixel centers lie at integers.

        Depth is along the line of sight; where it is not positive, column and row mean
        nothing.
        """
        height, width = size
        right, up, depth = jnp.moveaxis((points - self.position) @ self.axes().T, -1, 0)
        ratio = self.focal(height) / jnp.where(depth > 0, depth, 1)
        column, row = (width - 1) / 2 + ratio * right, (height - 1) / 2 - ratio * up
        return jnp.stack([column, row, depth], axis=-1)
