"""The point that fits tangent planes best, with a derivative everywhere.

Planes n_i . (x - p_i) = 0, i = 1..m, about their mean point c, with y = x - c,
H = sum n_i n_i^T / m and r = sum n_i n_i . (p_i - c) / m: the least squares H y = r is
singular on flat patches (H has rank 1) and on edges (rank 2), and a truncated
eigenvalue decomposition has no derivative there. Tikhonov's step, repeated,

    y <- y + (H + w I)^-1 (r - H y),    y = 0 at first, k times

multiplies the component of the solution at an eigenvalue m by 1 - (w / (m + w))^k: near
1 where the planes determine it, near k m / w -> 0 where they do not, smooth between.
With w = 0.01 and k = 4 the corner of a cube (m = 1/3) is off by 1e-6 of the distance
from the mean point; one step with w = 0.001 by 3e-3.

In a box the unconstrained minimiser may lie outside: the coordinate that is furthest
out is fixed to its bound, and the others are solved again, until none is left.

Coordinates come first and patches last, so that every operation runs along the patches.

Ju, Losasso, Schaefer and Warren (2002); the mean point: Schaefer and Warren (2002).
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


class Planes(eqx.Module):
    """The planes of every patch: mean point, H, r, and the sum of the normals.

    `normal` holds the entries xx, xy, xz, yy, yz, zz of the symmetric H.
    """

    mean: Float[Array, "3 v"]
    normal: Float[Array, "6 v"]
    right: Float[Array, "3 v"]
    direction: Float[Array, "3 v"]


def fit_planes(read: Callable, slots, like: Float[Array, " v"]) -> Planes:
    """The planes through the crossings of every patch.

    One after the other: `read(slot)` gives the points (three rows [v]), the normals
    and the weights, one or zero, of the crossings that `slots`, a tree of arrays
    [k, ...], holds at one place. `like` is any array of the dtype and size. A patch
    without crossings gets zeros.
    """

    def add(sums, slot):
        point, normal, weight = read(slot)
        normal = [weight * n for n in normal]
        along = sum(n * p for n, p in zip(normal, point, strict=True))
        products = [normal[i] * normal[j] for i, j in PAIRS]
        terms = [weight, *(weight * p for p in point), *products]
        terms = [*terms, *(along * n for n in normal), *normal]
        return [a + b for a, b in zip(sums, terms, strict=True)], None

    sums = lax.scan(add, [jnp.zeros_like(like)] * 16, slots)[0]
    number = jnp.maximum(sums[0], 1)
    mean, normal = (jnp.stack(x) / number for x in (sums[1:4], sums[4:10]))
    right = jnp.stack(sums[10:13]) / number - jnp.stack(times(normal, mean))
    return Planes(mean, normal, right, jnp.stack(sums[13:]))


def minimize(planes: Planes, low, high, weight, steps: int) -> Float[Array, "3 v"]:
    """The regularised least-squares points of the planes in boxes [low, high].

    `low` and `high` are three numbers, or three rows [v].
    """
    low = [low[d] - planes.mean[d] for d in range(3)]
    high = [high[d] - planes.mean[d] for d in range(3)]

    # A loop, because XLA on CPUs computes the inverse again for all that follows it.
    def fix_one_more(state, _):
        free, held, _ = state
        y = _solve(planes, free, held, weight, steps)
        return (*_fix_worst(y, free, held, low, high), y), None

    zero = jnp.zeros_like(planes.mean[0])
    start = ([zero + 1] * 3, [zero] * 3, [zero] * 3)
    return planes.mean + jnp.stack(lax.scan(fix_one_more, start, None, length=4)[0][2])


def approach(planes: Planes, weight, steps: int) -> Float[Array, "3 v"]:
    """The regularised least-squares points of the planes, anywhere."""
    zero = jnp.zeros_like(planes.mean[0])
    free, held = [zero + 1] * 3, [zero] * 3
    return planes.mean + jnp.stack(_solve(planes, free, held, weight, steps))


def _fix_worst(y, free, held, low, high):
    """The free coordinate that is furthest out of the box is held at its bound."""
    # Which bound is met is a choice: it has no derivative.
    beyond = [
        lax.stop_gradient(jnp.where(f > 0, jnp.maximum(lo - x, x - hi), -1.0))
        for x, f, lo, hi in zip(y, free, low, high, strict=True)
    ]
    worst = jnp.maximum(jnp.maximum(beyond[0], beyond[1]), beyond[2])
    open_, out_free, out_held = worst > 0, [], []
    for d in range(3):
        fix = open_ & (beyond[d] == worst)
        # The first of several that are out equally far.
        open_ = open_ & ~fix
        out_free.append(jnp.where(fix, 0.0, free[d]).astype(y[d].dtype))
        bound = jnp.where(y[d] < low[d], low[d], high[d])
        out_held.append(jnp.where(fix, bound, held[d]))
    return out_free, out_held


def _solve(planes, free, held, weight, steps):
    """Tikhonov's steps for the free coordinates; the others are `held`."""
    x, y, z = free
    full = planes.normal
    fixed = times(full, held)
    right = [free[d] * (planes.right[d] - fixed[d]) for d in range(3)]
    masks = (x * x, x * y, x * z, y * y, y * z, z * z)
    normal = [m * a for m, a in zip(masks, full, strict=True)]
    inverse = _inverse([a + weight * (i in (0, 3, 5)) for i, a in enumerate(normal)])
    out = times(inverse, right)
    for _ in range(steps - 1):
        miss = [r - a for r, a in zip(right, times(normal, out), strict=True)]
        out = [a + b for a, b in zip(out, times(inverse, miss), strict=True)]
    return [f * a + h for f, a, h in zip(free, out, held, strict=True)]


def times(a, x):
    """The symmetric matrices a times the vectors x."""
    xx, xy, xz, yy, yz, zz = a
    return [
        xx * x[0] + xy * x[1] + xz * x[2],
        xy * x[0] + yy * x[1] + yz * x[2],
        xz * x[0] + yz * x[1] + zz * x[2],
    ]


def _inverse(a):
    """The inverses of symmetric positive definite matrices, by their cofactors."""
    xx, xy, xz, yy, yz, zz = a
    first = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    rest = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    scale = 1 / (xx * first[0] + xy * first[1] + xz * first[2])
    return [c * scale for c in (*first, *rest)]
