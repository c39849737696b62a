"""All scans of one object aligned together, in one least-squares problem.

Scan i is moved by T_i. For a point p of scan i and its closest point q of scan j, with
normal n, in the world: x = T_i p, y = T_j q, N = R_j n, and the residual is

    r = N . (x - y).

Perturb from the left, T <- exp(xi) T with xi = (w, v): x moves by w_i x x + v_i, y and
N turn by w_j. The terms in w_j add up to -w_j . (x x N), whatever x - y is, so

    dr = J (xi_i - xi_j),   J = (x x N, N).

A pair of scans sees the difference of their motions only: with A_ij = sum w J^T J and
g_ij = sum w J r the normal equations are a graph Laplacian of 6 x 6 blocks, fixed by
xi_0 = 0 (the gauge).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core import (
    RESULTS,
    GeometryError,
    check_shape,
    failure_where,
    first_failure,
    message,
    safe_divide,
)
from ..clouds import thin
from ..neighbors import AbstractBackend, build, knn
from ..shapes import PointCloud
from ..transforms import Rigid
from ._kernels import AbstractKernel, Tukey

_FACING = 0.7
_FEWEST = 12


class MultiView(eqx.Module):
    """The poses of b scans that fit together best.

    - `world_from_scan`: a batched `Rigid`; the first is the one given.
    - `overlap` [b, b]: the share of (thinned) scan i with a match in scan j.
    - `num_matches` [b]: matches of each scan, in both roles.
    - `rmse`: of the residuals along the normals, weighted by the kernel, in the unit of
      the points.
    - `num_steps`: Gauss-Newton steps at each level.
    - `result`: `too_few_points` where a scan has none, `capacity_exceeded`,
      `no_consensus` where a scan matches no other, `not_converged`.
    """

    world_from_scan: Rigid
    overlap: Float[Array, "b b"]
    num_matches: Int[Array, " b"]
    rmse: Float[Array, ""]
    num_steps: Int[Array, " levels"]
    result: RESULTS


def multiview(
    clouds: PointCloud,
    start: Rigid,
    *,
    voxel_size: Float[Array, ""] | float,
    capacity: int = 16_384,
    kernel: AbstractKernel | None = None,
    levels: tuple[float, ...] = (4.0, 2.0, 1.0),
    gate: float = 3.0,
    max_steps: int = 40,
    rtol: float = 1e-3,
    backend: AbstractBackend | None = None,
) -> MultiView:
    """The poses that minimise the sum of rho(r^2) over the matches of all scans.

    Gauss-Newton with new matches at every step, from coarse to fine.

    **Arguments:**

    - `clouds`: a stacked `PointCloud` [b, n, ...] with oriented normals.
    - `start`: a batched `Rigid` [b], world_from_scan, right to about the coarsest gate;
      see `match_views` and `spanning_poses`. The first pose is kept (the gauge).
    - `voxel_size`: scans are thinned to one point per voxel of `levels` times this
      size, in the unit of the points.
    - `capacity`: room for the thinned points of a scan, static.
    - `kernel`: `Tukey()` by default, as wide as the residuals of a step ask for.
    - `gate`: matches are nearer than this many voxels, and their normals differ by less
      than 45 degrees.
    - `max_steps`, `rtol`: of each level; steps that move no point by more than `rtol`
      voxels end it.
    - `backend`: how matches are found (see `neighbors.build`).

    Poses are constants under differentiation; points moved by them are not. Raises
    `GeometryError` for clouds without normals or a start of another size.
    """
    _check(clouds, start)
    kernel = Tukey() if kernel is None else kernel
    clouds, start = jax.lax.stop_gradient(
        (jax.tree.map(jnp.asarray, clouds), jax.tree.map(jnp.asarray, start))
    )
    b = clouds.points.shape[0]
    pairs = jnp.asarray([(i, j) for i in range(b) for j in range(b) if i != j])
    poses, counts, overflow, done = start, [], jnp.zeros((), bool), None
    for level in levels:
        size = level * jnp.asarray(voxel_size, clouds.points.dtype)
        # A surface has about 1 / level^2 as many voxels; twice that leaves a margin.
        room = max(_FEWEST, min(capacity, int(2 * capacity / level**2)))
        scans, required = jax.lax.map(
            partial(thin, voxel_size=size, capacity=room), clouds
        )
        overflow |= jnp.any(required > room)
        limits = (gate * size, rtol * size)
        problem = _Problem(scans, pairs, kernel, backend, *limits)
        poses, count, done = problem.solve(poses, max_steps)
        counts.append(count)
    return problem.conclude(poses, jnp.stack(counts), overflow, done)


class _Problem(eqx.Module):
    """Thinned scans at one level, and the ordered pairs (source, target) of them."""

    scans: PointCloud
    pairs: Int[Array, "p 2"]
    kernel: AbstractKernel
    backend: AbstractBackend
    gate: Float[Array, ""]
    atol: Float[Array, ""]

    def build(self):
        """The search structures of all scans."""
        one = lambda scan: build(scan.points, scan.mask, backend=self.backend)
        return jax.lax.map(one, self.scans)

    def solve(self, poses, max_steps):
        """Poses, steps, and whether the last step moved nothing."""
        index = self.build()
        center, reach = self.frame(poses)

        def step(carry):
            poses, count, _, width = carry
            matches = self.match(index, poses)
            twist, width, _ = self.step(matches, poses, center, reach, width)
            move = jax.vmap(lambda x: _about(center, x))(twist)
            poses = jax.vmap(lambda a, b: a @ b)(move, poses)
            size = jnp.max(_lengths(twist[:, :3]) * reach + _lengths(twist[:, 3:]))
            return poses, count + 1, size <= self.atol, width

        going = lambda carry: (carry[1] < max_steps) & ~carry[2]
        far = jnp.asarray(jnp.inf, self.gate.dtype)
        start = (poses, jnp.int32(0), jnp.zeros((), bool), far)
        poses, count, done, _ = jax.lax.while_loop(going, step, start)
        return poses, count, done

    def frame(self, poses):
        """The middle of all points, and the radius about it."""
        world = jax.vmap(lambda pose, x: pose(x))(poses, self.scans.points)
        mask = self.scans.mask[..., None]
        count = jnp.maximum(jnp.sum(mask), 1).astype(world.dtype)
        center = jnp.sum(jnp.where(mask, world, 0), axis=(0, 1)) / count
        away = jnp.where(mask, world - center, 0)
        reach = jnp.sqrt(jnp.max(jnp.sum(away**2, axis=-1)))
        return center, jnp.where(reach > 0, reach, 1)

    def match(self, index, poses):
        """The target point [p, n] of every source point, and where it counts."""

        def one(pair):
            source, target = (
                jax.tree.map(lambda x, k=k: x[k], (self.scans, index, poses))
                for k in pair
            )
            (here, _, pose), (there, tree, base) = source, target
            between = base.inverse() @ pose
            near = knn(
                tree,
                between(here.points),
                1,
                mask=here.mask,
                max_distance=self.gate,
            )
            found = near.mask[:, 0]
            item = jnp.where(found, near.indices[:, 0], 0)
            turned = here.normals @ between.rotation.T
            facing = jnp.sum(turned * there.normals[item], axis=1) > _FACING
            return item, found & facing

        # One at a time: together every search would wait for the longest.
        return jax.lax.map(one, self.pairs)

    def residuals(self, matches, poses, center):
        """r [p, n], and x - center and N [p, n, 3]."""
        item, use = matches
        source, target = self.pairs[:, 0], self.pairs[:, 1]
        world = jax.vmap(lambda pose, x: pose(x) - center)(poses, self.scans.points)
        normals = jax.vmap(lambda pose, n: n @ pose.rotation.T)(
            poses, self.scans.normals
        )
        x = world[source]
        gather = jax.vmap(lambda rows, i: rows[i])
        y, normal = gather(world[target], item), gather(normals[target], item)
        r = jnp.sum(normal * (x - y), axis=-1)
        return jnp.where(use, r, 0), x, normal

    def step(self, matches, poses, center, reach, width):
        """The twists about the center, the width of the kernel, the weighted rms."""
        r, x, normal = self.residuals(matches, poses, center)
        use = matches[1]
        width = self.kernel.width(jnp.square(r).ravel(), use.ravel(), width)
        safe = jnp.where(width > 0, width, 1)
        weight = jnp.where(use, self.kernel.weight(jnp.square(r / safe)), 0)
        # Rotations in units of 1 / reach: all six numbers are lengths.
        rows = jnp.concatenate([jnp.cross(x, normal) / reach, normal], axis=-1)
        tall = rows * weight[..., None]
        blocks = jnp.einsum("pni,pnj->pij", tall, rows)
        sides = jnp.einsum("pni,pn->pi", tall, r)
        twist = _solve_laplacian(blocks, sides, self.pairs, poses.translation.shape[0])
        scaled = jnp.concatenate([twist[:, :3] / reach, twist[:, 3:]], axis=1)
        rms = jnp.sqrt(safe_divide(jnp.sum(weight * r**2), jnp.sum(weight)))
        return scaled, width, rms

    def conclude(self, poses, counts, overflow, done) -> MultiView:
        """The result, with new matches at the final poses."""
        index = self.build()
        matches = self.match(index, poses)
        center, reach = self.frame(poses)
        far = jnp.asarray(jnp.inf, self.gate.dtype)
        _, _, rms = self.step(matches, poses, center, reach, far)
        b = self.scans.mask.shape[0]
        found = jnp.sum(matches[1], axis=1)
        sizes = jnp.sum(self.scans.mask, axis=1)
        table = jnp.zeros((b, b), found.dtype)
        table = table.at[self.pairs[:, 0], self.pairs[:, 1]].set(found)
        overlap = safe_divide(table.astype(rms.dtype), sizes.astype(rms.dtype)[:, None])
        each = jnp.sum(table, axis=0) + jnp.sum(table, axis=1)
        result = first_failure(
            failure_where(jnp.any(sizes < _FEWEST), RESULTS.too_few_points),
            failure_where(overflow, RESULTS.capacity_exceeded),
            failure_where(jnp.any(each < _FEWEST), RESULTS.no_consensus),
            failure_where(~done, RESULTS.not_converged),
        )
        return MultiView(poses, overlap, each, rms, counts, result)


def _solve_laplacian(blocks, sides, pairs, b) -> Float[Array, "b 6"]:
    """The motions that minimise sum |J (xi_i - xi_j) + r|^2 with xi_0 = 0."""
    i, j = pairs[:, 0], pairs[:, 1]
    matrix = jnp.zeros((b, b, 6, 6), blocks.dtype)
    matrix = matrix.at[i, i].add(blocks).at[j, j].add(blocks)
    matrix = matrix.at[i, j].add(-blocks).at[j, i].add(-blocks)
    side = jnp.zeros((b, 6), blocks.dtype).at[i].add(-sides).at[j].add(sides)
    free = jnp.arange(b) > 0
    matrix = jnp.where((free[:, None] & free[None, :])[..., None, None], matrix, 0)
    full = matrix.transpose(0, 2, 1, 3).reshape(6 * b, 6 * b)
    # Scans without matches, and directions that no match sees, stay where they are.
    trace = jnp.trace(full) / (6 * b)
    damping = jnp.where(trace > 0, 8 * jnp.finfo(full.dtype).eps * trace, 1)
    full = full + damping * jnp.eye(6 * b, dtype=full.dtype)
    side = jnp.where(free[:, None], side, 0).reshape(-1)
    factor = jax.scipy.linalg.cho_factor(full)
    return jax.scipy.linalg.cho_solve(factor, side).reshape(b, 6)


def _about(center, twist) -> Rigid:
    """The motion of a twist about `center`."""
    move = Rigid.exp(twist)
    return Rigid(move.rotation, move.translation + center - move.rotation @ center)


def _lengths(x):
    return jnp.sqrt(jnp.sum(x**2, axis=-1))


def _check(clouds, start):
    if clouds.normals is None:
        raise GeometryError(
            message(
                "multiview needs oriented normals",
                "normals=None",
                "Call normals.estimate and orient_toward_viewpoint first.",
            )
        )
    b = np.shape(clouds.points)[0]
    check_shape("start.translation", start.translation, (b, 3))
    if b < 2:
        raise GeometryError(
            message("multiview needs at least two scans", f"{b}", "Stack more clouds.")
        )
