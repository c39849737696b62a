"""The mean of many shapes and the alignment of each to it, with missing points."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._core import (
    RESULTS,
    check_shape,
    failure_where,
    first_failure,
    safe_divide,
)
from ._procrustes import procrustes
from ._transforms import Rigid, Similarity


class GeneralizedFit(eqx.Module):
    """The mean shape [n, d], the batched transforms mean_from_shape [k], their joint
    rms distance to the mean, the number of alternations, and the status."""

    mean: Float[Array, "n d"]
    transforms: Rigid | Similarity
    rmse: Float[Array, ""]
    steps: Int[Array, ""]
    result: RESULTS


class _Problem(eqx.Module):
    """Washed shapes, which points they have, and how one of them is aligned."""

    shapes: Float[Array, "k n d"]
    mask: Bool[Array, "k n"]
    scaling: bool = eqx.field(static=True)
    reflection: bool = eqx.field(static=True)

    def fit(self, mean, seen):
        """Every shape aligned to the points of `mean` that are `seen`."""
        one = partial(procrustes, scaling=self.scaling, reflection=self.reflection)
        return jax.vmap(lambda x, m: one(x, mean, mask=m & seen))(
            self.shapes, self.mask
        )


def generalized_procrustes(
    shapes: Float[Array, "k n d"],
    mask: Bool[Array, "k n"] | None = None,
    *,
    scaling: bool = False,
    reflection: bool = False,
    rtol: float | None = None,
    max_steps: int = 500,
) -> GeneralizedFit:
    """The mean M and transforms T_k that minimise sum_k sum_i |T_k(x_ki) - M_i|^2.

    The sum runs over the points that shape k has. Alternates the alignment of every
    shape to the mean with the mean of the aligned shapes. What the sum leaves free is
    fixed: the mean has its centroid at zero, the first shape is not turned, and with
    `scaling` the rms distance of the mean's points from zero is one (the sum is then
    minimised relative to the size of the mean). Without scaling lengths stay those of
    the shapes.

    **Arguments:**

    - `shapes`: [k, n, d]; point i of one shape corresponds to point i of every other.
    - `mask`: [k, n], False for a missing point. Points that are not finite are missing.
    - `scaling`, `reflection`: as in `procrustes`.
    - `rtol`: stop when the mean moves by less than this, relative to its size; 64
      rounding units by default.
    - `max_steps`: the most alternations.

    A point that no shape has is zero in the mean. The result is `too_few_points` or
    `degenerate_input` where some shape cannot be aligned (it then has no say in mean
    and rmse), or `not_converged`. Derivatives are those of the fixed point (implicit
    function theorem), forward and reverse. Raises `GeometryError` for shapes that do
    not agree.

    Source: Gower 1975, Generalized Procrustes analysis; ten Berge 1977 for scaling.
    """
    check_shape("shapes", shapes, (None, None, None))
    shapes = jnp.asarray(shapes)
    real = jnp.all(jnp.isfinite(shapes), axis=-1)
    if mask is not None:
        check_shape("mask", mask, shapes.shape[:2])
        real = real & mask
    problem = _Problem(jnp.where(real[..., None], shapes, 0), real, scaling, reflection)
    rtol = 64 * jnp.finfo(shapes.dtype).eps if rtol is None else rtol
    # The way to the fixed point has no part in its derivative.
    still = jax.lax.stop_gradient(problem)
    found, steps, moved = _alternate(still, _start(still), rtol, max_steps)
    mean = jax.lax.custom_root(
        lambda mean: _advance(problem, mean) - mean,
        found,
        lambda _, found: found,
        partial(_solve_tangent, max_steps=max_steps),
    )
    return _finish(problem, mean, steps, moved <= rtol)


def _start(problem):
    """The fullest shape, and the others taken in one after the other, each aligned to
    the mean so far."""
    one = partial(procrustes, scaling=problem.scaling, reflection=problem.reflection)
    fullest = jnp.argmax(jnp.sum(problem.mask, axis=1))

    def take(carry, shape):
        total, count = carry
        points, mask = shape
        mean = safe_divide(total, count[:, None])
        fit = one(points, mean, mask=mask & (count > 0))
        use = mask & (fit.result == RESULTS.successful)
        total = total + jnp.where(use[:, None], fit.transform(points), 0)
        return (total, count + use.astype(total.dtype)), None

    first = problem.shapes[fullest], problem.mask[fullest].astype(problem.shapes.dtype)
    others = problem.mask.at[fullest].set(False)
    (total, count), _ = jax.lax.scan(take, first, (problem.shapes, others))
    return _normalize(safe_divide(total, count[:, None]), count, problem.scaling)


def _advance(problem, mean):
    """One alternation: align all shapes to the mean, and average them."""
    fit = problem.fit(mean, jnp.any(problem.mask, axis=0))
    use = problem.mask & (fit.result == RESULTS.successful)[:, None]
    moved = jax.vmap(lambda t, x: t(x))(fit.transform, problem.shapes)
    total = jnp.sum(jnp.where(use[..., None], moved, 0), axis=0)
    count = jnp.sum(use, axis=0).astype(mean.dtype)
    return _normalize(safe_divide(total, count[:, None]), count, problem.scaling)


def _normalize(mean, count, scaling):
    """Centroid zero and, with scaling, rms radius one; points count by `count`.

    With that count the scaled average is the minimiser on the sphere it stays on.
    """
    share = safe_divide(count, jnp.sum(count))
    mean = jnp.where((count > 0)[:, None], mean - share @ mean, 0)
    if not scaling:
        return mean
    square = share @ jnp.sum(mean**2, axis=1)
    return mean / jnp.sqrt(jnp.where(square > 0, square, 1))


def _alternate(problem, mean, rtol, max_steps):
    """The fixed point, the steps taken, and the last relative change."""

    def step(carry):
        mean, steps, _ = carry
        new = _advance(problem, mean)
        size = jnp.sqrt(jnp.sum(new**2))
        change = safe_divide(jnp.sqrt(jnp.sum((new - mean) ** 2)), size)
        return new, steps + 1, change

    going = lambda carry: (carry[1] < max_steps) & (carry[2] > rtol)
    start = (mean, jnp.zeros((), jnp.int32), jnp.full((), jnp.inf, mean.dtype))
    return jax.lax.while_loop(going, step, start)


def _solve_tangent(operator, right, max_steps):
    """(A - I) x = b by x <- A x - b, which converges as the alternation does.

    A has the eigenvalue one for turns of the mean, but no alternation turns it.
    """

    def solve(matvec, b):
        rtol = 64 * jnp.finfo(b.dtype).eps

        def step(carry):
            x, steps, _ = carry
            new = x + matvec(x) - b
            far = jnp.sum((new - x) ** 2) > rtol**2 * jnp.sum(new**2)
            return new, steps + 1, far

        start = (-b, jnp.zeros((), jnp.int32), jnp.asarray(True))
        going = lambda carry: carry[2] & (carry[1] < max_steps)
        return jax.lax.while_loop(going, step, start)[0]

    return jax.lax.custom_linear_solve(operator, right, solve, transpose_solve=solve)


def _finish(problem, mean, steps, converged):
    """The transforms, in the gauge that is promised."""
    seen = jnp.any(problem.mask, axis=0)
    first = jax.tree.map(lambda x: x[0], problem.fit(mean, seen).transform)
    mean = mean @ first.rotation
    mean = _normalize(mean, seen.astype(mean.dtype), problem.scaling)
    fit = problem.fit(mean, seen)
    moved = jax.vmap(lambda t, x: t(x))(fit.transform, problem.shapes)
    use = problem.mask & (fit.result == RESULTS.successful)[:, None]
    gaps = jnp.where(use[..., None], moved - mean, 0)
    count = jnp.sum(use).astype(mean.dtype)
    square = safe_divide(jnp.sum(gaps**2), count)
    rmse = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
    some = lambda status: failure_where(jnp.any(fit.result == status), status)
    result = first_failure(
        some(RESULTS.too_few_points),
        some(RESULTS.degenerate_input),
        failure_where(~converged, RESULTS.not_converged),
    )
    return GeneralizedFit(mean, fit.transform, rmse, steps, result)
