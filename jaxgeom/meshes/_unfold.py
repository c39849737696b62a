"""Distances along the surface by unfolding one triangle after the other."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .._core import safe_divide


def unfold(
    faces: Int[Array, "f 3"],
    lengths: Float[Array, "f 3"],
    source: Bool[Array, " v"],
    max_steps: int,
) -> tuple[Float[Array, " v"], Int[Array, ""]]:
    """The distances from the nearest source, and the number of steps until they rest.

    A triangle that knows the distances of two of its corners unfolds the source into
    its plane; the third corner is as far as the straight line from there, if it enters
    through their side, or farther along a side. Every corner takes the least of what
    its triangles offer, until nothing changes. Then the triangle that each corner
    follows is kept, and the distances are made those of these triangles exactly, which
    is where the derivative comes from. `lengths` [f, 3] are those of the sides opposite
    to the corners; padding faces name v.
    """
    still = lax.stop_gradient(lengths)
    distance, spread = _spread(faces, still, source, max_steps)
    followed = _followed(faces, still, distance)
    follow = lambda d, sides: jnp.where(
        source, 0, _take(_offers_at(faces, d, sides), followed)
    )
    distance, _ = _until_rest(lambda d: follow(d, still), distance, max_steps)
    reached = jnp.isfinite(distance)
    return _differentiable(follow, lengths, distance, reached, max_steps), spread


def _spread(faces, lengths, source, max_steps):
    """The least offers, from the sources outward."""
    start = jnp.where(source, 0, jnp.inf).astype(lengths.dtype)
    least = lambda d: d.at[faces].min(_offers_at(faces, d, lengths), mode="drop")
    return _until_rest(least, start, max_steps)


def _until_rest(step, start, max_steps):
    def more(carry):
        _, moving, steps = carry
        return moving & (steps < max_steps)

    def once(carry):
        old, _, steps = carry
        new = step(old)
        reached = jnp.isfinite(new)
        rounding = 8 * jnp.finfo(new.dtype).eps * jnp.where(reached, new, 0)
        gap = jnp.where(reached, jnp.abs(jnp.where(reached, new - old, 0)), 0)
        return new, jnp.any(gap > rounding), steps + 1

    end = lax.while_loop(more, once, (start, jnp.asarray(True), jnp.int32(0)))
    return end[0], end[2]


def _followed(faces, lengths, distance):
    """The corner (3 face + corner) whose offer each vertex takes; 3f for none."""
    last = 3 * faces.shape[0]
    offers = _offers_at(faces, distance, lengths)
    best = jnp.full_like(distance, jnp.inf).at[faces].min(offers, mode="drop")
    wins = offers == best.at[faces].get(mode="fill", fill_value=-1)
    wins &= jnp.isfinite(offers)
    corner = jnp.arange(last, dtype=jnp.int32).reshape(faces.shape)
    empty = jnp.full(distance.shape, last, jnp.int32)
    return empty.at[faces].min(jnp.where(wins, corner, last), mode="drop")


def _take(offers, followed):
    # The last one, which is none, is there even for a mesh without faces.
    return jnp.append(offers.reshape(-1), jnp.inf)[followed]


def _differentiable(follow, lengths, distance, reached, max_steps):
    """`distance`, with the derivative of the fixed point (implicit functions)."""
    washed = lambda x: jnp.where(reached, x, 0)
    step = lambda d, sides: washed(follow(jnp.where(reached, d, jnp.inf), sides))
    still = lax.stop_gradient(washed(distance))
    offered = step(still, lengths)
    change = offered - lax.stop_gradient(offered)
    constant = lax.stop_gradient(lengths)
    hand_on = lambda x: jax.jvp(lambda d: step(d, constant), (still,), (x,))[1]
    hand_back = lambda y: jax.vjp(lambda d: step(d, constant), still)[1](y)[0]
    answer = lax.custom_linear_solve(
        lambda x: x - hand_on(x),
        change,
        lambda _, b: _sum_of_walks(hand_on, b, max_steps),
        transpose_solve=lambda _, b: _sum_of_walks(hand_back, b, max_steps),
    )
    return jnp.where(reached, still + answer, jnp.inf)


def _sum_of_walks(walk, b, max_steps):
    """b + P b + P^2 b + ..., until the terms are rounded off."""
    goal = jnp.finfo(b.dtype).eps * jnp.max(jnp.abs(b), initial=0)

    def once(carry):
        total, term, steps = carry
        term = walk(term)
        return total + term, term, steps + 1

    def more(carry):
        return (jnp.max(jnp.abs(carry[1]), initial=0) > goal) & (carry[2] < max_steps)

    return lax.while_loop(more, once, (b, b, jnp.int32(0)))[0]


def _offers_at(faces, distance, lengths):
    near = distance.at[faces].get(mode="fill", fill_value=jnp.inf)
    return _offers(near, lengths)


def _offers(near, lengths):
    """How far each corner is by way of the two others; infinite if unknown."""
    j, k = jnp.roll(near, -1, axis=1), jnp.roll(near, -2, axis=1)
    side = lengths
    to_j, to_k = jnp.roll(lengths, -2, axis=1), jnp.roll(lengths, -1, axis=1)
    known_j, known_k = jnp.isfinite(j), jnp.isfinite(k)
    j, k = jnp.where(known_j, j, 0), jnp.where(known_k, k, 0)
    along_j = jnp.where(known_j, j + to_j, jnp.inf)
    along_k = jnp.where(known_k, k + to_k, jnp.inf)
    x, y = _apex(side, to_j, to_k)
    source_x, depth = _apex(side, j, k)
    enters = source_x + (x - source_x) * safe_divide(depth, depth + y)
    through = known_j & known_k & (jnp.abs(j - k) <= side) & (depth + y > 0)
    through &= (enters >= 0) & (enters <= side)
    square = (x - source_x) ** 2 + (y + depth) ** 2
    straight = jnp.sqrt(jnp.where(through & (square > 0), square, 1))
    return jnp.where(through, straight, jnp.minimum(along_j, along_k))


def _apex(side, left, right):
    """The point at distances `left` and `right` of the ends of a side, above it."""
    x = safe_divide(side**2 + left**2 - right**2, 2 * side)
    around = side + left + right
    # A source in line with the side is often there, and the root of a rounding error is
    # no height: half of the digits would be lost.
    rounding = 4 * jnp.finfo(around.dtype).eps * around
    gaps = [left + right - side, side + right - left, side + left - right]
    above = (gaps[0] > rounding) & (gaps[1] > rounding) & (gaps[2] > rounding)
    square = jnp.where(above, around * gaps[0] * gaps[1] * gaps[2], 1)
    height = jnp.where(above, jnp.sqrt(square), 0)
    return x, safe_divide(height, 2 * side)
