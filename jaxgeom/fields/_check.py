"""Whether a field keeps its promises: the contract, run on any field."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._core import safe_norm
from ._claims import Bounds, Claims, Trust
from ._field import claims

_RESOLUTION = 64


class Contract(eqx.Module):
    """How far a field is from its promises at some points (0 or less: kept).

    - `finite`: all values and gradients, in the point and in the parameters.
    - `steepness`: the largest slope, of gradients and of secants, over the Lipschitz
      constant, less 1.
    - `outside`, `inside`: the largest error of the exact distance where it is promised:
      how far x - f grad f lands from the surface, and | |grad f| - 1 |.
    - `box`: how far points of the body lie outside the box, and points outside the body
      outside of theirs.
    - `growth`: how far a value is below growth times the distance to the box.
    """

    finite: Bool[Array, ""]
    steepness: Float[Array, ""]
    outside: Float[Array, ""]
    inside: Float[Array, ""]
    box: Float[Array, ""]
    growth: Float[Array, ""]


class Report(eqx.Module):
    """What `check_field` found; `print` it to read it.

    - `kept`: whether all promises are kept.
    - `lines`: one sentence for each promise; that of a broken one begins with BROKEN.
    - `contract`: the numbers behind them, in double precision.
    """

    kept: bool
    lines: tuple[str, ...]
    contract: Contract

    def __str__(self):
        return "\n".join(self.lines)


def check_field(
    field: Callable,
    *,
    low=None,
    high=None,
    count: int = 1000,
    seed: int = 0,
    tolerance: float = 1e-6,
) -> Report:
    """Whether a field keeps the contract of fields: run it on your own (host).

    Checked at `count` random points, and at special ones (corners, centers, axes):
    values and gradients are finite, also those in the parameters; slopes stay below the
    Lipschitz constant; where an exact distance is promised, one step along the gradient
    lands on the surface with slope 1; the body lies in its box; float32 agrees with
    float64; jit with the plain call; vmap with a loop. Sampling finds most broken
    promises, it does not prove that one is kept.

    **Arguments:**

    - `field`: any callable point [3] -> number. What it promises is in its `claims`; of
      a plain function nothing is known, see `declare`.
    - `low`, `high`: [3] each, where to look; the field's box by default (2 around the
      origin where that has no end).
    - `tolerance`: errors up to this times the size of the box are rounding.
    """
    with jax.enable_x64(True):
        wide = _cast(field, np.float64)
        seen = claims(wide)
        where = seen.bounds if low is None else Bounds.of(_corner(low), _corner(high))
        points, special = map(jnp.asarray, probes(where, count, seed))
        found = jax.device_get(eqx.filter_jit(contract)(wide, points, special, seen))
        seen = jax.device_get(seen)
        scale = 1 + float(np.abs(points).max())
        few = points[:8]
        values = np.asarray(jax.vmap(lambda x: wide(x))(few))
        jitted = np.asarray(eqx.filter_jit(lambda f, x: f(x))(wide, few[0]))
        alone = np.stack([np.asarray(wide(x)) for x in few])
    narrow = jax.vmap(lambda x: field(x))(jnp.asarray(np.float32(few)))
    single = float(np.abs(values - np.asarray(narrow)).max())
    limits = tolerance * scale, float(jnp.finfo(jnp.float32).eps) * 1000 * scale
    agreement = (
        np.abs(jitted - alone[0]).max(),
        np.abs(values - alone).max(),
        single,
    )
    lines = [*_contract_lines(found, seen, limits[0]), *_agreement(agreement, limits)]
    texts = tuple(("kept: " if good else "BROKEN: ") + text for good, text in lines)
    return Report(all(good for good, _ in lines), texts, found)


def _contract_lines(found: Contract, seen: Claims, limit: float):
    """(kept, sentence) for each promise that the field makes."""
    yield bool(found.finite), "values and gradients are finite at all points"
    steep = float(seen.lipschitz)
    if np.isfinite(steep):
        most = (1 + float(found.steepness)) * steep
        text = f"the Lipschitz constant is {steep:.4g}, the largest slope {most:.4g}"
        yield bool(found.steepness <= limit), text
    elif np.isnan(steep):
        yield True, "no Lipschitz constant is promised: give one to `declare`"
    else:
        yield True, "there is no Lipschitz constant: tracing needs `within` or a bound"
    for side in ("outside", "inside"):
        trust, error = getattr(seen.exactness, side), float(getattr(found, side))
        if trust == Trust.EXACT:
            text = f"the distance is exact {side}, the largest error {error:.2g}"
            yield bool(error <= limit), text
    text = f"the body lies in its box (beyond it by {float(found.box):.2g})"
    yield bool(found.box <= limit), text
    text = f"outside its box the field grows as promised (lacking {found.growth:.2g})"
    yield bool(found.growth <= limit), text


def _agreement(errors, limits):
    double, single = limits
    names = (
        "jit and plain call agree",
        "vmap and loop agree",
        "float32 and float64 agree",
    )
    for name, error, limit in zip(names, errors, (double, double, single), strict=True):
        yield bool(error <= limit), f"{name} (difference {float(error):.2g})"


def _cast(field, dtype):
    cast = lambda x: jnp.asarray(x, dtype) if eqx.is_inexact_array(x) else x
    return jax.tree.map(cast, field)


def _corner(x):
    return jnp.asarray(np.asarray(x, float))


def contract(
    field: Callable,
    points: Float[Array, "n d"],
    special: Float[Array, "m d"],
    seen: Claims,
) -> Contract:
    """The measures of the contract against the claims `seen`.

    At `special` points, where several parts of the surface may be equally near, all but
    the gradient of an exact distance is measured.
    """
    values, slopes, finite = _two_looks(field, jnp.concatenate([points, special]))
    n = points.shape[0]
    f, size, landed = values[0], safe_norm(slopes), values[1, :n]
    error = jnp.maximum(jnp.abs(landed), jnp.abs(size[:n] - 1))
    everywhere = jnp.concatenate([points, special])
    return Contract(
        finite,
        _steepest(everywhere, f, size) / seen.lipschitz - 1,
        _where_exact(seen.exactness.outside, f[:n] > 0, error),
        _where_exact(seen.exactness.inside, f[:n] < 0, error),
        *_beyond_boxes(seen, everywhere, f),
    )


def _two_looks(field, points):
    """Values [2, n] at points and where they land, slopes [n, d], and whether all is
    finite: one program that runs twice."""
    both = eqx.filter_value_and_grad(lambda pair: pair[0](pair[1]))

    def look(x, _):
        f, (by_field, slope) = jax.vmap(lambda p: both((field, p)))(x)
        leaves = [f, slope, *jax.tree.leaves(eqx.filter(by_field, eqx.is_array))]
        finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(y)) for y in leaves]))
        return x - f[:, None] * slope, (f, slope, finite)

    _, (values, slopes, finite) = jax.lax.scan(look, points, length=2)
    return values, slopes[0], finite[0]


def _steepest(points, f, size):
    """The largest slope, of gradients and of secants."""
    apart = safe_norm(jnp.roll(points, 1, axis=0) - points)
    rise = jnp.abs(jnp.roll(f, 1) - f)
    secant = jnp.where(apart > 0, rise / jnp.where(apart > 0, apart, 1), 0)
    return jnp.max(jnp.maximum(size, secant))


def _where_exact(trust, side, error):
    kept = side & (trust == Trust.EXACT)
    return jnp.max(jnp.where(kept, error, 0))


def _beyond_boxes(seen, points, f):
    """How far the body and its complement leave their boxes, and what is lacking to the
    growth outside of them."""
    out, lack = [], []
    for box, height in ((seen.inside, f), (seen.outside, -f)):
        gap = safe_norm(
            jnp.maximum(jnp.maximum(box.low - points, points - box.high), 0)
        )
        beyond = gap > 0
        least = jnp.where(beyond, box.growth, 0) * gap
        out.append(jnp.max(jnp.where(height <= 0, gap, 0)))
        lack.append(jnp.max(jnp.where(beyond, least - height, 0)))
    return jnp.maximum(*out), jnp.maximum(*lack)


def probes(bounds: Bounds, count: int, seed: int):
    """Random points [count, d] in and around a box, and special ones [m, d]: center,
    corners and middles of the box and of a cube, and the origin (host).

    A side without end becomes 2 long beyond the other, or reaches from -2 to 2.
    """
    low, high = (np.asarray(x, float) for x in (bounds.low, bounds.high))
    start = np.where(np.isfinite(low), low, np.where(np.isfinite(high), high - 2, -2))
    stop = np.where(np.isfinite(high), high, start + np.where(np.isfinite(low), 2, 4))
    center, half = (start + stop) / 2, np.abs(stop - start) / 2
    d = len(low)
    draws = np.random.default_rng(seed).uniform(-1, 1, (count, d))
    random = center + (half + half.max() / 2) * draws
    lattice = np.stack(np.meshgrid(*[(-1.0, 0.0, 1.0)] * d), -1).reshape(-1, d)
    special = [center + half * lattice, half.max() * lattice, np.zeros((1, d))]
    return random, np.concatenate(special)
