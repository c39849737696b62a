"""Normals from bare points by repeated Poisson reconstruction."""

import equinox as eqx
import jax
import jax.numpy as jnp

from .._core import safe_normalize
from ..linear import interpolate
from ..normals import AbstractOrientation, WindingConsistency
from ..reconstruction import Poisson
from ..shapes import Grid


class IteratedPoisson(AbstractOrientation):
    """Normals that are the gradient of the Poisson field that they make.

    Reconstructs a field on `resolution`^3 nodes from the normals of `start`
    (`WindingConsistency()` on the same grid by default), takes the direction in which
    it rises at the points as new normals, and repeats until they turn by less than
    `settled` radians in the mean, at most `rounds` times. `method` makes the field:
    `Poisson()` by default, or `ScreenedPoisson()`. Constant under differentiation.

    After Hou et al., Iterative Poisson surface reconstruction (iPSR) for unoriented
    points, ACM TOG 2022; there the normals come from the faces of a mesh.
    """

    start: AbstractOrientation | None = None
    method: eqx.Module = Poisson()
    resolution: int = eqx.field(static=True, default=64)
    rounds: int = eqx.field(static=True, default=15)
    settled: float = 0.005

    def __call__(self, cloud):
        points = jax.lax.stop_gradient(cloud.washed().points)
        cloud = eqx.tree_at(lambda c: c.points, cloud, points)
        start = self.start or WindingConsistency(resolution=self.resolution, levels=2)
        grid = Grid.around(cloud, resolution=self.resolution)
        q = grid.index_of(cloud.points)
        count = jnp.maximum(jnp.sum(cloud.mask), 1)

        def round_(state):
            normals, _, rounds = state
            field = self.method(cloud.with_normals(normals), grid)
            rise = [
                interpolate(slope, q)
                for slope in jnp.gradient(field.values, *grid.spacing)
            ]
            new = safe_normalize(jnp.stack(rise, -1)) * cloud.mask[:, None]
            chord = jnp.linalg.norm(new - normals, axis=-1)
            return new, jnp.sum(chord) / count, rounds + 1

        def turning(state):
            _, turn, rounds = state
            return (turn > self.settled) & (rounds < self.rounds)

        first = jax.lax.stop_gradient(start(cloud).normals)
        far = jnp.full((), jnp.inf, first.dtype)
        normals, _, _ = jax.lax.while_loop(turning, round_, (first, far, 0))
        return cloud.with_normals(jax.lax.stop_gradient(normals))
