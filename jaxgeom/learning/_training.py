"""Adam: the one training loop of all networks, jitted in chunks."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PyTree

from .._core import RESULTS, GeometryError, failure_where, first_failure, message

CHUNK = 100


def number(x) -> Float[Array, ""]:
    """A setting as a strongly typed array: other values are no new programs."""
    return jnp.asarray(x, float)


class Adam(eqx.Module):
    """Adam with a learning rate that falls along half a cosine to `final` of itself.

    m <- b1 m + (1 - b1) g,  v <- b2 v + (1 - b2) g^2,
    x <- x - rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + epsilon).

    A step whose loss or gradient is not finite is left out, and counted. Source:
    D. Kingma, J. Ba, Adam: a method for stochastic optimization, 2015, algorithm 1.
    """

    num_steps: int = eqx.field(static=True, default=2000)
    rate: Float[Array, ""] = eqx.field(converter=number, default=2e-3)
    final: float = eqx.field(static=True, default=0.02)
    b1: float = eqx.field(static=True, default=0.9)
    b2: float = eqx.field(static=True, default=0.99)
    epsilon: float = eqx.field(static=True, default=1e-8)

    def __check_init__(self):
        if self.num_steps < 1:
            raise GeometryError(
                message(
                    "training needs at least 1 step",
                    f"num_steps={self.num_steps}",
                    "Typical values are 500 to 5000.",
                )
            )


class Trained(eqx.Module):
    """A model after training.

    - `losses` [num_steps]: the loss before every step.
    - `num_skipped`: steps left out because loss or gradient was not finite.
    - `result`: `diverged` where steps were skipped or the loss ended above where it
      started; `not_converged` where it did not fall.
    """

    model: PyTree
    losses: Float[Array, " s"]
    num_skipped: Int[Array, ""]
    result: RESULTS


class _State(eqx.Module):
    model: PyTree
    mean: PyTree
    square: PyTree
    step: Int[Array, ""]
    skipped: Int[Array, ""]


def train(
    model: PyTree,
    loss: Callable,
    data: PyTree,
    *,
    key: Key[Array, ""],
    adam: Adam | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Trained:
    """The model whose floating leaves minimise a random loss (host: in chunks).

    **Arguments:**

    - `loss`: loss(model, data, key) -> []. An `eqx.Module` or a module-level function:
      a new closure would be a new program.
    - `data`: a pytree of arrays handed to the loss.
    - `key`: a typed key, used once; step i draws with fold_in(key, i), so that the
      result does not depend on the chunks.
    - `progress`: called as progress(steps done, loss) after every 100 steps.

    **Statuses:** `diverged`, `not_converged` (see `Trained`).
    """
    adam = Adam() if adam is None else adam
    state, losses = _begin(model), []
    total = jnp.asarray(adam.num_steps, jnp.int32)
    for done in range(0, adam.num_steps, CHUNK):
        state, values = _chunk(state, loss, data, key, adam.rate, _fixed(adam), total)
        losses.append(np.asarray(values))
        if progress is not None:
            last = min(CHUNK, adam.num_steps - done)
            progress(done + last, float(losses[-1][last - 1]))
    losses = jnp.asarray(np.concatenate(losses)[: adam.num_steps])
    return Trained(state.model, losses, state.skipped, _verdict(losses, state.skipped))


def train_jit(
    model: PyTree,
    loss: Callable,
    data: PyTree,
    *,
    key: Key[Array, ""],
    adam: Adam | None = None,
) -> Trained:
    """As `train`, as one pure scan, for use inside your own `jax.jit` and `jax.vmap`
    (many shapes at once: models, data and keys with a batch axis)."""
    adam = Adam() if adam is None else adam
    total = jnp.asarray(adam.num_steps, jnp.int32)
    step = lambda state, _: _step(state, loss, data, key, adam, total)
    state, losses = jax.lax.scan(step, _begin(model), length=adam.num_steps)
    return Trained(state.model, losses, state.skipped, _verdict(losses, state.skipped))


def _begin(model):
    model = jax.tree.map(lambda x: jnp.asarray(x) if eqx.is_array(x) else x, model)
    zeros = jax.tree.map(jnp.zeros_like, eqx.filter(model, eqx.is_inexact_array))
    return _State(model, zeros, zeros, jnp.int32(0), jnp.int32(0))


def _fixed(adam):
    """The settings less what changes no program: the number of steps and the rate."""
    return Adam(1, 0.0, adam.final, adam.b1, adam.b2, adam.epsilon)


@eqx.filter_jit
def _chunk(state, loss, data, key, rate, adam, total):
    adam = eqx.tree_at(lambda a: a.rate, adam, rate)
    step = lambda state, _: _step(state, loss, data, key, adam, total)
    return jax.lax.scan(step, state, length=CHUNK)


def _step(state, loss, data, key, adam, total):
    """One step of Adam, or none where it would not be finite or lies beyond the end."""
    draw = jax.random.fold_in(key, state.step)
    value, slope = eqx.filter_value_and_grad(loss)(state.model, data, draw)
    finite = jnp.isfinite(value)
    for leaf in jax.tree.leaves(slope):
        finite &= jnp.all(jnp.isfinite(leaf))
    live = state.step < total
    step = state.step + 1
    blend = lambda b: lambda old, new: b * old + (1 - b) * new
    mean = jax.tree.map(blend(adam.b1), state.mean, slope)
    square = jax.tree.map(
        blend(adam.b2), state.square, jax.tree.map(lambda g: g * g, slope)
    )
    change = jax.tree.map(_change(adam, step, total), mean, square)
    moved = eqx.apply_updates(state.model, change)
    keep = lambda new, old: jnp.where(finite & live, new, old) if _traced(old) else old
    model, mean, square = (
        jax.tree.map(keep, new, old)
        for new, old in (
            (moved, state.model),
            (mean, state.mean),
            (square, state.square),
        )
    )
    skipped = state.skipped + (live & ~finite).astype(jnp.int32)
    return _State(model, mean, square, step, skipped), value


def _traced(x):
    return eqx.is_inexact_array(x)


def _change(adam, step, total):
    """The step of one leaf, at time `step` of `total`."""

    def change(mean, square):
        t = step.astype(mean.dtype)
        share = jnp.minimum(t / total.astype(mean.dtype), 1)
        fall = adam.final + (1 - adam.final) * (1 + jnp.cos(jnp.pi * share)) / 2
        first, second = mean / (1 - adam.b1**t), square / (1 - adam.b2**t)
        rate = adam.rate.astype(mean.dtype) * fall
        return -rate * first / (jnp.sqrt(second) + adam.epsilon)

    return change


def _verdict(losses, skipped):
    """Compares the first and the last tenth of the losses."""
    some = -(-losses.shape[0] // 10)
    first, last = jnp.mean(losses[:some]), jnp.mean(losses[-some:])
    flat = (last == first) & (skipped == 0)
    # A NaN compares as false: it counts as diverged.
    diverged = failure_where(~(last <= first) | (skipped > 0), RESULTS.diverged)
    return first_failure(diverged, failure_where(flat, RESULTS.not_converged))
