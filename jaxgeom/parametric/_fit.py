"""NURBS through scattered points, by linear least squares."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import RESULTS, check_shape, failure_where, safe_divide, safe_norm
from ._abstract import floating
from ._nurbs import NurbsCurve, NurbsSurface
from ._splines import SplineBasis


class NurbsFit(eqx.Module):
    """A curve or surface fitted to points.

    - `shape`: the fitted NURBS.
    - `parameters`: t [n] or uv [n, 2] of the points on it.
    - `rmse`: the root of the weighted mean of |X(parameters) - point|^2.
    - `result`: `too_few_points` where some control points are not determined.
    """

    shape: NurbsCurve | NurbsSurface
    parameters: Float[Array, "n *d"]
    rmse: Float[Array, ""]
    result: RESULTS


def chord_length(points: Float[Array, "n d"], *, power: float = 1.0, closed=False):
    """Parameters [n] from 0 to 1 that grow with the distance of the points in a row.

    t_k = sum over i < k of |p_(i+1) - p_i|^power over the whole; power 1/2 is the
    centripetal rule. A `closed` row goes on from the last point to the first, so that
    the last parameter is less than 1.
    """
    points = floating(points)
    following = jnp.roll(points, -1, axis=0) if closed else points[1:]
    steps = safe_norm(following - points[: len(following)]) ** power
    total = jnp.concatenate([jnp.zeros(1, steps.dtype), jnp.cumsum(steps)])
    return safe_divide(total, total[-1])[: len(points)]


def grid_parameters(points: Float[Array, "a b 3"], *, power: float = 1.0):
    """Parameters [a, b, 2] from 0 to 1 of points in rows and columns.

    u is the mean over the columns of the parameters of `chord_length` along them, and
    v that over the rows.
    """
    points = floating(points)
    along = jax.vmap(lambda row: chord_length(row, power=power))
    u, v = jnp.mean(along(points.swapaxes(0, 1)), axis=0), jnp.mean(along(points), 0)
    return jnp.stack(jnp.meshgrid(u, v, indexing="ij"), axis=-1)


def fit_curve(
    points: Float[Array, "n d"],
    basis: SplineBasis,
    *,
    parameters: Float[Array, " n"] | None = None,
    weights: Float[Array, " n"] | None = None,
    control_weights: Float[Array, " m"] | None = None,
    smoothing: float = 0.0,
    closed: bool = False,
) -> NurbsFit:
    """The NURBS curve over `basis` nearest to points at given parameters.

    Minimises mean_i w_i |c(t_i) - p_i|^2 + smoothing * mean |second differences of the
    control points|^2, by one QR decomposition.

    **Arguments:**

    - `parameters` [n]: in the domain of the basis; by chord length by default.
    - `weights` [n]: of the points; 0 leaves one out. One by default.
    - `control_weights` [m]: of the control points, not fitted; one by default.
    - `smoothing`: the pull of neighboring control points into a row.
    - `closed`: for a basis of `SplineBasis.closed`; the first control points are
      repeated at the end.

    **Statuses:** `too_few_points` where the points do not determine all control points
    and `smoothing` is 0.

    Differentiable in points, parameters and weights. Refine it with `refine_fit`.
    """
    points = floating(points)
    check_shape("points", points, (None, None))
    if parameters is None:
        share = chord_length(points, closed=closed)
        parameters = basis.low + share * (basis.high - basis.low)
    rows = jax.vmap(basis.values)(floating(parameters))
    wrap = jnp.asarray(_wrapping(basis, closed), points.dtype)
    first = _ones(control_weights, basis.num_control, points)
    rows = rows * first / (rows @ first)[:, None]
    pulls = jnp.asarray(_second_differences(basis.num_control), points.dtype)
    control, result = _solve(rows @ wrap, pulls @ wrap, points, weights, smoothing)
    curve = NurbsCurve(wrap @ control, basis, first, closed=closed)
    return _fitted(curve, parameters, points, weights, result)


def fit_surface(
    points: Float[Array, "n 3"],
    bases: tuple[SplineBasis, SplineBasis],
    *,
    parameters: Float[Array, "n 2"],
    weights: Float[Array, " n"] | None = None,
    control_weights: Float[Array, "m k"] | None = None,
    smoothing: float = 0.0,
) -> NurbsFit:
    """The NURBS surface over `bases` nearest to scattered points at parameters [n, 2].

    Minimises mean_i w_i |X(u_i, v_i) - p_i|^2 + smoothing * mean |second differences of
    the net, along u, along v and mixed|^2, by one QR decomposition. For points in rows
    and columns take the parameters of `grid_parameters`.

    Other arguments, **statuses** and derivatives as for `fit_curve`.
    """
    points, parameters = floating(points), floating(parameters)
    check_shape("points", points, (None, 3))
    check_shape("parameters", parameters, (points.shape[0], 2))
    values = [
        jax.vmap(basis.values)(parameters[:, axis]) for axis, basis in enumerate(bases)
    ]
    rows = jnp.einsum("ni,nj->nij", *values).reshape(points.shape[0], -1)
    shape = tuple(basis.num_control for basis in bases)
    first = _ones(control_weights, shape, points)
    rows = rows * first.ravel() / (rows @ first.ravel())[:, None]
    pulls = jnp.asarray(_net_differences(*shape), points.dtype)
    control, result = _solve(rows, pulls, points, weights, smoothing)
    surface = NurbsSurface(control.reshape(*shape, 3), bases, first)
    return _fitted(surface, parameters, points, weights, result)


def fit_pulls(shape: NurbsCurve | NurbsSurface) -> np.ndarray:
    """The rows whose products with the control points the smoothing makes small."""
    if isinstance(shape, NurbsCurve):
        return _second_differences(shape.control.shape[0])
    return _net_differences(*shape.control.shape[:2])


def _solve(rows, pulls, points, weights, smoothing):
    """Control points [m, d] of the least sum of squares, and a status."""
    n = points.shape[0]
    share = jnp.sqrt(_ones(weights, n, points) / n)[:, None]
    pull = jnp.sqrt(jnp.asarray(smoothing, points.dtype) / max(len(pulls), 1))
    system = jnp.concatenate([share * rows, pull * pulls])
    side = jnp.concatenate(
        [share * points, jnp.zeros_like(points, shape=(len(pulls), points.shape[1]))]
    )
    # With fewer rows than unknowns QR has no square factor: rows of zero add none.
    lack = max(0, system.shape[1] - system.shape[0])
    pad = lambda x: jnp.pad(x, ((0, lack), (0, 0)))
    q, r = jnp.linalg.qr(pad(system))
    pivots = jnp.abs(jnp.diagonal(r))
    eps = jnp.finfo(points.dtype).eps
    lost = pivots <= 4 * system.shape[1] * eps * jnp.max(pivots)
    safe = r + jnp.diag(jnp.where(lost, jnp.max(pivots), 0))
    control = jax.scipy.linalg.solve_triangular(safe, q.T @ pad(side))
    return control, failure_where(jnp.any(lost), RESULTS.too_few_points)


def _fitted(shape, parameters, points, weights, result):
    gaps = safe_norm(jax.vmap(shape)(parameters) - points) ** 2
    share = _ones(weights, points.shape[0], points)
    rmse = jnp.sqrt(safe_divide(share @ gaps, jnp.sum(share)))
    return NurbsFit(shape, floating(parameters), rmse, result)


def _ones(given, shape, points):
    if given is None:
        return jnp.ones(shape, points.dtype)
    given = floating(given)
    check_shape("weights", given, shape if isinstance(shape, tuple) else (shape,))
    return given


def _second_differences(n):
    return np.diff(np.eye(n), 2, axis=0)


def _net_differences(n, m):
    """Second differences along both axes and the mixed one, twice as dear."""
    one, two = np.eye(n), np.eye(m)
    mixed = np.kron(np.diff(one, axis=0), np.diff(two, axis=0))
    along = np.kron(np.diff(one, 2, axis=0), two), np.kron(one, np.diff(two, 2, axis=0))
    return np.concatenate([*along, np.sqrt(2) * mixed])


def _wrapping(basis, closed):
    """The matrix that repeats the first control points of a closed curve."""
    n = basis.num_control
    free = n - basis.degree if closed else n
    return np.eye(free)[np.arange(n) % free]
