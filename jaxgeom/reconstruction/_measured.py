"""What all methods read from a cloud, and how they answer."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._core import (
    RESULTS,
    failure_where,
    first_failure,
    safe_divide,
    safe_normalize,
)
from ..linear import LinearSolution, interpolate
from ..shapes import Grid, PointCloud
from ._density import SampleGeometry, sample_geometry
from ._divergence import levels_for
from ._solution import FieldSolution, PoissonStats

_FEWEST_POINTS = 4


class Samples(eqx.Module):
    """The usable samples in node indices, with normals in units of the mean spacing."""

    q: Float[Array, "n 3"]
    normals: Float[Array, "n 3"]
    real: Bool[Array, " n"]
    result: RESULTS
    num_ignored: Array


class Measured(eqx.Module):
    """Samples on a grid, and what each of them stands for.

    - `geometry`: areas, density and noise, lengths in spacings.
    - `strength`: [n], area times confidence. `unit`: the mean spacing.
    - `levels`: how many coarser grids sparse samples may use.
    """

    samples: Samples
    geometry: SampleGeometry
    strength: Float[Array, " n"]
    unit: Float[Array, ""]
    grid: Grid
    levels: int = eqx.field(static=True)

    @staticmethod
    def of(
        cloud: PointCloud,
        grid: Grid,
        weights: Float[Array, " n"] | None,
        levels: int | None,
        token: Bool[Array, ""] | None,
    ) -> "Measured":
        """The samples of a cloud; `levels` None: from their number and the grid."""
        if levels is None:
            levels = levels_for(cloud.points.shape[0], grid.shape)
        samples = usable_samples(cloud, grid)
        found = sample_geometry(
            samples.q,
            samples.normals,
            samples.real,
            grid.shape,
            levels=levels,
            token=token,
        )
        strength = found.area if weights is None else found.area * weights
        unit = jnp.prod(grid.spacing) ** (1 / 3)
        return Measured(samples, found, strength, unit, grid, levels)

    @property
    def q(self) -> Float[Array, "n 3"]:
        """The samples in node indices."""
        return self.samples.q

    @property
    def normals(self) -> Float[Array, "n 3"]:
        """Their unit normals; zero for what is not used."""
        return self.samples.normals

    def answer(self, solution: LinearSolution, screening) -> FieldSolution:
        """The field of nodal values, with the level through the samples."""
        at_samples = interpolate(solution.value, self.q)
        total = jnp.sum(self.strength)
        level = safe_divide(jnp.sum(self.strength * at_samples), total)
        found, unit = self.geometry, self.unit
        stats = PoissonStats(
            solution.residual,
            solution.steps,
            screening,
            found.noise * unit,
            found.area * unit**2,
            self.samples.num_ignored,
        )
        result = first_failure(self.samples.result, solution.result)
        density = found.density / unit**2
        return FieldSolution(self.grid, solution.value, level, density, result, stats)


def without_steps(value: Float[Array, "x y z"]) -> LinearSolution:
    """Values that were found without iteration, as a solution."""
    zero = jnp.zeros((), value.dtype)
    return LinearSolution(value, zero, jnp.int32(0), RESULTS.successful)


def usable_samples(cloud: PointCloud, grid: Grid) -> Samples:
    """Drop what cannot be used, and say so."""
    cloud = cloud.washed()
    finite = jnp.isfinite(cloud.points).all(-1) & jnp.isfinite(cloud.normals).all(-1)
    points = jnp.where(finite[:, None], cloud.points, 0.0)
    normals = safe_normalize(jnp.where(finite[:, None], cloud.normals, 0.0))
    q = grid.index_of(points)
    within = ((q >= 0.5) & (q <= jnp.asarray(grid.shape) - 1.5)).all(-1)
    directed = (normals != 0).any(-1)
    real = cloud.mask & finite & within & directed
    # Ignored samples go to the middle of the box, with weight 0.
    middle = (jnp.asarray(grid.shape, q.dtype) - 1) / 2
    q = jnp.where(real[:, None], q, middle)
    bad = lambda good: jnp.any(cloud.mask & ~good)
    result = first_failure(
        failure_where(jnp.sum(real) < _FEWEST_POINTS, RESULTS.too_few_points),
        failure_where(bad(finite), RESULTS.nonfinite_input),
        failure_where(bad(directed | ~finite), RESULTS.zero_normals),
        failure_where(bad(within), RESULTS.outside_grid),
    )
    normals = jnp.where(real[:, None], normals, 0.0)
    return Samples(q, normals, real, result, jnp.sum(cloud.mask & ~real))
