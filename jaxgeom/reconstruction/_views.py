"""What rays and cameras meet in a distribution of fields, and where to scan next."""

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from .._core import RESULTS, safe_normalize
from ..fields import Camera
from ..linear import interpolate
from ..shapes import Grid
from ..transforms import rotation_exp
from ._descend import descend
from ._stochastic import chance_inside


def probability_hit(
    samples: Float[Array, "s x y z"], grid: Grid, points: Float[Array, "*r m 3"]
) -> Float[Array, "*r"]:
    """The share of sampled fields that are negative at any of some points [..., m, 3]:
    a region, or the points along a ray. Joint, unlike the product over the points; NaN
    where a sample is NaN."""
    flat = points.reshape(-1, 3)
    found = lax.map(lambda v: interpolate(v, grid.index_of(flat)), samples)
    found = found.reshape(len(samples), *points.shape[:-1])
    hit = jnp.any(found < 0, axis=-1).astype(samples.dtype)
    known = jnp.all(jnp.isfinite(found), axis=-1)
    return jnp.mean(jnp.where(known, hit, jnp.nan), axis=0)


def view_score(
    samples: Float[Array, "s x y z"],
    grid: Grid,
    origins: Float[Array, "r 3"],
    directions: Float[Array, "r 3"],
    *,
    length: Float[Array, ""] | float,
    num_steps: int = 64,
) -> Float[Array, ""]:
    """How much of what a camera sees is unknown: where to scan next, it is large.

    With P(x) the probability inside at a point, from the mean and the deviation of the
    samples at the nodes, the mean over the rays of

        sum_j prod_{i < j} (1 - P_i)  (1/2 - |P_j - 1/2|) step,

    a length: the path through unsure space before the ray has surely hit something.
    Differentiable with respect to the rays, so to the pose of the camera.

    **Arguments:** `origins`, `directions` (unit) of the rays, `length` that they are
    followed, in `num_steps` steps. Outside of the grid nothing is seen.
    """
    inside = chance_inside(jnp.mean(samples, axis=0), jnp.std(samples, axis=0))
    step = length / num_steps
    t = (jnp.arange(num_steps) + 0.5) * step
    points = origins[:, None] + t[:, None] * directions[:, None]
    q = grid.index_of(points)
    p = interpolate(inside, q.reshape(-1, 3)).reshape(points.shape[:2])
    p = jnp.where(grid.holds(points), p, 0)
    passed = jnp.cumprod(1 - p, axis=1)
    before = jnp.concatenate([jnp.ones_like(p[:, :1]), passed[:, :-1]], axis=1)
    return jnp.mean(jnp.sum(before * (0.5 - jnp.abs(p - 0.5)), axis=1)) * step


class NextView(eqx.Module):
    """A camera about its target, moved to where it sees most of what is unknown.

    `score` and `first_score` are the `view_score` there and at the start; the camera is
    never a worse one. `result` is `not_converged` where the search was cut short,
    `nonfinite_input` where a sample is NaN.
    """

    camera: Camera
    score: Float[Array, ""]
    first_score: Float[Array, ""]
    steps: Int[Array, ""]
    result: RESULTS


def next_view(
    samples: Float[Array, "s x y z"],
    grid: Grid,
    camera: Camera,
    *,
    length: Float[Array, ""] | float,
    size: tuple[int, int] = (12, 12),
    num_steps: int = 48,
    max_steps: int = 40,
    rtol: float = 1e-3,
) -> NextView:
    """The pose from which a camera sees most of what the samples leave open.

    The camera is turned about its target, its distance kept, by gradient ascent on
    `view_score` (BFGS on the rotation vector). The maximum is a local one: start from
    several sides, by `jax.vmap` over the cameras, and keep the best.

    **Arguments:** `size` (static): the rays of the camera, rows and columns; `length`,
    `num_steps`: as in `view_score`; `max_steps`: evaluations of the score, at most;
    `rtol`: of the score and of the angle in radians, where the search ends.
    """

    def turned(w):
        turn = rotation_exp(w)
        arm = turn @ (camera.position - camera.target)
        # What is up turns along: it never lies along the line of sight.
        up = turn @ safe_normalize(camera.up)
        return Camera(camera.target + arm, camera.target, up, camera.field_of_view)

    def score(w):
        seen = turned(w)
        rays = seen.directions(size).reshape(-1, 3)
        origins = jnp.broadcast_to(seen.position, rays.shape)
        how = {"length": length, "num_steps": num_steps}
        return view_score(samples, grid, origins, rays, **how)

    # In units of the score at the start, so that steps suit any length.
    still = jnp.zeros(3, camera.position.dtype)
    first = score(still)
    unit = jnp.where(first > 0, first, length)
    loss = lambda w: -score(w) / unit
    found = descend(loss, still, rtol=rtol, max_steps=max_steps)
    best = -unit * found.loss
    return NextView(turned(found.value), best, first, found.steps, found.result)
