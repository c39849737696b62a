"""Hermite data: where each cut edge meets the surface, and the normal there.

From samples: the root of the line through both ends, and central differences. From the
field itself: the root of f on the edge by the Illinois variant of regula falsi (the
bracket is kept, the order is 1.44, kinks do no harm), and the gradient of f at it. One
step of Newton with the slope held fixed moves a root by nothing and gives it the
derivative of the implicit function theorem: dt = -df / (df/dt).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .._core import safe_divide, safe_normalize, stage
from ..shapes import Grid
from ._placement import Linear
from ._vertices import CutEdges, Samples, directions, positions

# A dual vertex keeps this distance from the sides of its cell, in cells: faces have an
# area then.
CLEARANCE = 1e-3

_STEPS = 12


class Hermite(eqx.Module):
    """Crossings of cut edges: the parameter in [0, 1] and the unit normal."""

    t: Float[Array, " e"]
    normals: Float[Array, "e 3"]


def from_samples(values, edges: CutEdges, grid: Grid, level, token) -> Hermite:
    """Hermite data of sampled values."""
    samples = Samples(values, edges)
    t = stage(token, lambda s, v: jnp.clip(Linear()(s, v), 0, 1), samples, level)
    return Hermite(t, directions(t, samples, grid, token))


def from_field(
    field: Callable, values, edges: CutEdges, inside, grid: Grid, level
) -> Hermite:
    """Hermite data of a field, of which `values` are the samples.

    Where the field does not change sign as the samples do, as beside a layer of outside
    nodes around the grid, the line through the samples and the axis of the edge.
    `inside` tells of every edge whether its lower node is.
    """
    samples = Samples(values, edges)
    line = Linear()(samples, level)
    along = lambda t: jax.vmap(field)(positions(t, edges, grid)) - level
    start, stop = along(jnp.zeros_like(line)), along(jnp.ones_like(line))
    changes = jnp.isfinite(start) & jnp.isfinite(stop)
    changes = changes & ((start < 0) == inside) & ((stop < 0) != inside)
    root = _root(along, start, stop, lax.stop_gradient(changes), line)
    points = positions(root, edges, grid)
    gradient = jax.vmap(jax.grad(field))(points)
    sound = changes & jnp.all(jnp.isfinite(gradient), axis=-1)
    growing = jnp.where(inside, 1.0, -1.0).astype(root.dtype)
    axis = jax.nn.one_hot(edges.axis, 3, dtype=root.dtype) * growing[:, None]
    gradient = jnp.where(sound[:, None], gradient, axis)
    return Hermite(root, safe_normalize(gradient))


def _root(along, start, stop, changes, line):
    """The root of a function on every edge; `line` where it does not change sign."""
    bracket = (jnp.zeros_like(line), start, jnp.ones_like(line), stop)
    other, found = _illinois(along, lax.stop_gradient(bracket))
    found = lax.stop_gradient(jnp.where(changes, found, line))
    miss, slope = jax.jvp(along, (found,), (jnp.ones_like(found),))
    moved = found - safe_divide(miss, lax.stop_gradient(slope))
    # Newton may leave a kink: then the bracket knows better.
    between = (moved - found) * (moved - other) <= 0
    near = changes & (between | (jnp.abs(moved - found) < CLEARANCE))
    root = jnp.where(near, moved, jnp.where(changes, found, line))
    return jnp.clip(root, 0, 1)


def _illinois(along, bracket):
    """The last bracket of regula falsi, its newer end second; the value at an end that
    stays is halved."""

    def step(_, state):
        a, fa, b, fb = state
        c = b - fb * safe_divide(b - a, fb - fa)
        c = jnp.clip(c, jnp.minimum(a, b), jnp.maximum(a, b))
        fc = lax.stop_gradient(along(c))
        crossed = (fc < 0) != (fb < 0)
        return jnp.where(crossed, b, a), jnp.where(crossed, fb, fa / 2), c, fc

    other, _, newer, _ = lax.fori_loop(0, _STEPS, step, bracket)
    return other, newer
