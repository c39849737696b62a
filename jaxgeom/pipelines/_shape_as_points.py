"""A surface as points with normals, which move until it lies on a scan.

The field of the points is that of `spectral_poisson`, its surface the mesh of marching
cubes; the loss is the mean squared distance from the mesh to the scan and back, whose
gradient goes through extractor and solver to the points and their normals. The points
start on a sphere; from grid to finer grid they are drawn anew on the surface they made.

Source: S. Peng et al., Shape As Points: a differentiable Poisson solver, 2021.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from .._core import RESULTS, GeometryError, failure_where, first_failure, message
from ..isosurface import Capacity, extract, marching_cubes
from ..learning import Adam, train
from ..linear import interpolate
from ..meshes import keep_faces, large_components, sample_surface
from ..neighbors import build, knn
from ..reconstruction import spectral_poisson
from ..shapes import Grid, PointCloud, TriangleMesh
from ._prepare import unit_box

# Half of the period, in longest sides of the scan, and where the sphere begins.
_REACH, _RADIUS = 0.8, 0.4


class ShapeAsPoints(eqx.Module):
    """A surface that lies on a scan, and the points that make it.

    - `mesh`, `cloud`: in the unit and the place of the scan; the normals of the cloud
      are as long as they became.
    - `error`: the root of the last loss, over the last tenth of the steps, in the unit
      of the scan.
    - `losses`: [steps] of every grid, in squared longest sides.
    - `result`: `diverged`, `not_converged` (a loss that did not fall on the first
      grid), `no_surface`, `capacity_exceeded` (the surface has more area than four
      sections of the grid, and the loss did not see all of it). `notes`: what was
      estimated or ignored.
    """

    mesh: TriangleMesh
    cloud: PointCloud
    error: Float[Array, ""]
    losses: tuple[Float[Array, " s"], ...]
    result: RESULTS
    notes: tuple[str, ...] = eqx.field(static=True, default=())


class _Points(eqx.Module):
    """What is trained: points [n, 3] and vectors [n, 3]."""

    points: Float[Array, "n 3"]
    vectors: Float[Array, "n 3"]

    def field(self, grid, smoothing):
        """The field, 0 on average at the points."""
        values = spectral_poisson(self.points, self.vectors, grid, smoothing=smoothing)
        return values - jnp.mean(interpolate(values, grid.index_of(self.points)))


class _Distance(eqx.Module):
    """The loss: samples of the surface to the scan, and some of the scan to these."""

    grid: Grid
    smoothing: Float[Array, ""]
    num_samples: int = eqx.field(static=True)

    def __call__(self, model, scan, key):
        index, points = scan
        values = model.field(self.grid, self.smoothing)
        room = _room(self.grid)
        mesh = marching_cubes(values, self.grid, capacity=room, normals=False).mesh
        key_surface, key_scan = jax.random.split(key)
        drawn = sample_surface(mesh, self.num_samples, key=key_surface)
        some = jax.random.randint(key_scan, (self.num_samples,), 0, len(points))
        there = knn(index, drawn.points, 1, mask=drawn.mask)
        back = knn(build(drawn.points, drawn.mask), points[some], 1)
        return _mean_square(there) + _mean_square(back)


def _room(grid) -> Capacity:
    """Four times the largest section of the period; a sphere at the start has 0.8."""
    return Capacity.for_surface(grid.shape)


def _mean_square(near):
    found = near.mask[:, 0]
    total = jnp.sum(jnp.where(found, near.distances[:, 0], 0) ** 2)
    return total / jnp.maximum(jnp.sum(found), 1)


def shape_as_points(
    cloud: PointCloud | Float[Array, "n 3"],
    *,
    key: Key[Array, ""],
    resolutions: tuple[int, ...] = (32, 64, 128),
    steps: tuple[int, ...] = (300, 200, 100),
    num_points: int = 20_000,
    num_samples: int = 20_000,
    rate: float = 4e-3,
    smoothing: float = 1.0,
    min_component: float = 0.01,
    progress: Callable[[int, float], None] | None = None,
) -> ShapeAsPoints:
    """The closed surface near a scan, found from a sphere by gradients (host form).

    No normals are needed, and none are used: that the surface is closed and near the
    points decides the sides. Noise is averaged over cells and smoothing. Works in
    single precision.

    **Arguments:**

    - `cloud`: a `PointCloud` or points [n, 3], in any unit.
    - `key`: a typed key, used once.
    - `resolutions`, `steps`: nodes along each axis of a period 1.6 times the longest
      side, and steps of Adam on each grid, from coarse to fine.
    - `num_points`: points that move; `num_samples`: of the mesh and of the scan, drawn
      in every step.
    - `rate`: of Adam on the first grid, in longest sides; it halves from grid to grid.
    - `smoothing`: in spacings, see `spectral_poisson`.
    - `min_component`: bodies with fewer than this share of the faces of the largest are
      left out.
    - `progress`: called as progress(steps done on this grid, loss) every 100 steps.

    **Statuses:** see `ShapeAsPoints`. Raises `GeometryError` for the clouds that
    `prepare` refuses, and unless every grid has its steps.
    """
    if not 0 < len(resolutions) == len(steps):
        raise GeometryError(
            message(
                "every grid must have its number of steps, and there must be one",
                f"resolutions={resolutions}, steps={steps}",
                "Pass two tuples of one length, such as (32, 64) and (300, 200).",
            )
        )
    ready = unit_box(cloud)
    points = jnp.asarray(ready.cloud.points, jnp.float32)
    scan = (build(points), points)
    model, losses, results = _sphere(num_points), [], []
    for level, (size, number) in enumerate(zip(resolutions, steps, strict=True)):
        key, key_train, key_draw = jax.random.split(key, 3)
        spacing = jnp.full(3, 2 * _REACH / size)
        grid = Grid(jnp.full(3, -_REACH), spacing, (size, size, size))
        loss = _Distance(grid, jnp.asarray(smoothing), num_samples)
        adam = Adam(num_steps=number, rate=rate / 2**level, final=0.3)
        if level:
            model = _drawn(mesh, num_points, key_draw)
        found = train(model, loss, scan, key=key_train, adam=adam, progress=progress)
        model = found.model
        losses.append(found.losses)
        # On finer grids the loss begins where it was, and may end above it for noise.
        lost = failure_where(found.num_skipped > 0, RESULTS.diverged)
        results.append(lost if level else found.result)
        out = extract(model.field(grid, loss.smoothing), grid)
        large = large_components(out.mesh, min_fraction=min_component)
        mesh = keep_faces(out.mesh, large).trim()
    last = losses[-1][-max(1, len(losses[-1]) // 10) :]
    where = lambda x: np.asarray(x, np.float64) * ready.scale + ready.center
    placed = eqx.tree_at(lambda m: m.vertices, mesh, where(mesh.vertices))
    moved = PointCloud(where(model.points), model.vectors)
    error = jnp.sqrt(jnp.mean(last)) * ready.scale
    short = failure_where(
        len(out.mesh.vertices) > _room(grid).vertices, RESULTS.capacity_exceeded
    )
    result = first_failure(*results, short, out.result)
    return ShapeAsPoints(placed, moved, error, tuple(losses), result, ready.notes)


def _sphere(num) -> _Points:
    """Points evenly on a sphere, along a spiral."""
    i = np.arange(num) + 0.5
    z, turn = 1 - 2 * i / num, np.pi * (1 + 5**0.5) * i
    flat = np.sqrt(1 - z**2)
    unit = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
    return _Points(jnp.float32(_RADIUS * unit), jnp.float32(unit))


def _drawn(mesh, num, key) -> _Points:
    """Points of a mesh and their normals, uniform by area."""
    drawn = sample_surface(mesh, num, key=key)
    return _Points(drawn.points, drawn.normals)
