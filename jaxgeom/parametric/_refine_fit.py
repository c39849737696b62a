"""Fits whose parameters follow the fitted shape: Gauss-Newton on the distances."""

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from .._core import RESULTS, safe_divide, safe_norm
from ._abstract import floating
from ._box_newton import FIRST_DAMPING, descent, is_free, model, newton_step
from ._fit import NurbsFit, fit_pulls
from ._search import Search


def refine_fit(
    fit: NurbsFit,
    points: Float[Array, "n 3"],
    *,
    weights: Float[Array, " n"] | None = None,
    smoothing: float = 0.0,
    solver: optx.AbstractLeastSquaresSolver | None = None,
    max_steps: int = 16,
    corrections: int = 3,
) -> NurbsFit:
    """A fit improved by moving its control points and its parameters together.

    Minimises the energy of `fit_curve` over the control points, where each parameter is
    that of the nearest point of the moving curve or surface: `corrections` Newton steps
    from the given parameters, whose derivative enters the Jacobian (variable
    projection), so that points may slide along the shape; those that begin at an end of
    the domain stay there. Weights of control points stay.

    **Arguments:** `solver`: any least-squares solver of optimistix; by default
    `optimistix.Dogleg`.

    **Statuses:** `not_converged` after `max_steps`; the result is the best so far.

    The Jacobian is dense, [3 n, 3 control points]. Not differentiable. Points in single
    precision need a session without `jax_enable_x64`: optimistix mixes the two there.
    A start far off in its parameters may end in a local minimum.
    Source: W. Wang, H. Pottmann, Y. Liu, Fitting B-spline curves to point clouds by
    curvature-based squared distance minimization, 2006.
    """
    points = floating(points)
    n = points.shape[0]
    weights = jnp.ones(n, points.dtype) if weights is None else floating(weights)
    root = float(jnp.finfo(points.dtype).eps) ** 0.5
    solver = optx.Dogleg(rtol=root, atol=root) if solver is None else solver
    begin = fit.parameters.reshape(n, -1)
    pulls = jnp.asarray(fit_pulls(fit.shape), points.dtype)
    given = (fit.shape, points, begin, weights, pulls, jnp.asarray(smoothing))
    fold, start = _folded(fit.shape)
    # In units of the spread of the points: tolerances mean the same at any size.
    unit = safe_norm(jnp.std(points, axis=0))
    unit = jnp.where(unit > 0, unit, 1)

    def residual(free, given):
        shape, *rest = given
        return _gaps(_with_control(shape, fold(free)), corrections, *rest) / unit

    found = optx.least_squares(
        residual, solver, start, given, max_steps=max_steps, throw=False
    )
    shape = _with_control(fit.shape, fold(found.value))
    feet = _feet(shape, points, begin, corrections)
    gaps = safe_norm(jax.vmap(Search.of(shape))(feet) - points) ** 2
    rmse = jnp.sqrt(safe_divide(weights @ gaps, jnp.sum(weights)))
    success = found.result == optx.RESULTS.successful
    result = RESULTS.where(success, RESULTS.successful, RESULTS.not_converged)
    out = NurbsFit(shape, feet.reshape(fit.parameters.shape), rmse, result)
    arrays, static = eqx.partition(out, eqx.is_array)
    return eqx.combine(jax.lax.stop_gradient(arrays), static)


def _gaps(shape, corrections, points, begin, weights, pulls, smoothing):
    """The residuals: weighted gaps, then second differences of control points."""
    feet = _feet(shape, points, begin, corrections)
    gaps = jax.vmap(Search.of(shape))(feet) - points
    share = jnp.sqrt(weights / points.shape[0])[:, None]
    pull = jnp.sqrt(smoothing.astype(points.dtype) / max(len(pulls), 1))
    flat = shape.control.reshape(-1, points.shape[1])
    return jnp.concatenate([share * gaps, pull * (pulls @ flat)])


def _feet(shape, points, begin, corrections):
    """The parameters [n, d] of the nearest places, from `begin` on."""
    search = Search.of(shape)
    return jax.vmap(lambda p, y: _foot(search, p, y, corrections))(points, begin)


def _foot(search, point, y, corrections):
    frozen, held = search.frozen(), jax.lax.stop_gradient(point)
    options = frozen.options(held, jax.lax.stop_gradient(y))
    # At an end that may be left or not, the gap has a kink where descent would stick.
    pinned = (y <= options["lower"]) | (y >= options["upper"])
    options["still"] = jnp.where(pinned, jnp.inf, options["still"])
    gap = lambda x: frozen(x) - held

    def onward(carry, _):
        y, damping = carry
        there, damping, _ = descent(gap, y, damping, options)
        return (there, damping), None

    first = (jax.lax.stop_gradient(y), jnp.asarray(FIRST_DAMPING, y.dtype))
    (y, _), _ = jax.lax.scan(onward, first, length=corrections)
    local = jax.lax.stop_gradient(model(gap, y))
    # The Newton step at the foot: nearly zero, its derivative that of the foot.
    slope = jax.jacfwd(search)(y).T @ (search(y) - point)
    free = is_free(local.jacobian, local.slope, y, options)
    step = newton_step(local, slope, free)
    return y + step - jax.lax.stop_gradient(step)


def _with_control(shape, control):
    return eqx.tree_at(lambda s: s.control, shape, control)


def _folded(shape):
    """The free control points and how all follow: closed curves repeat the first."""
    curve_wraps = getattr(shape, "closed", False) is True
    if not curve_wraps:
        return (lambda free: free), shape.control
    p, n = shape.basis.degree, shape.control.shape[0]
    knots = shape.basis.knots
    if knots[0] == knots[p]:
        # A clamped closed curve meets itself in one point.
        return (lambda free: jnp.concatenate([free, free[:1]])), shape.control[:-1]
    return (lambda free: jnp.concatenate([free, free[:p]])), shape.control[: n - p]
