"""Rational B-spline curves and surfaces."""

from math import comb

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, check_shape, message
from ._abstract import AbstractCurve, AbstractSurface, floating
from ._domain import Domain, Interval
from ._splines import SplineBasis

# Nets of up to so many points are multiplied whole, larger ones gathered from.
_DENSE = 1024


class NurbsCurve(AbstractCurve):
    """c(t) = sum N_i(t) w_i P_i / sum N_i(t) w_i.

    **Arguments:**

    - `control` [n, d]: the control points P_i, d = 3 or any other.
    - `basis`: the functions N_i: knots and degree, static.
    - `weights` [n]: positive; one by default.
    - `closed`: the end of the domain is its begin, and the curve goes on there; static.

    Raises `GeometryError` for shapes that do not fit the basis and for weights that are
    not positive (where they are known).
    """

    control: Float[Array, "n d"]
    weights: Float[Array, " n"]
    basis: SplineBasis
    closed: bool = eqx.field(static=True)

    def __init__(self, control, basis: SplineBasis, weights=None, *, closed=False):
        self.control = floating(control)
        self.basis, self.closed = basis, closed
        check_shape("control", self.control, (None, None))
        self.weights = _weights(weights, self.control)
        _check_fit("control", self.control.shape[0], basis)

    @staticmethod
    def through_wrapped(points, degree: int = 3) -> "NurbsCurve":
        """The smooth closed curve on [0, 1] with the control points [n, d], in turn.

        Raises `GeometryError` for fewer points than the degree.
        """
        points = floating(points)
        basis = SplineBasis.closed(points.shape[0], degree)
        wrapped = jnp.concatenate([points, points[:degree]])
        return NurbsCurve(wrapped, basis, closed=True)

    def evaluate(self, t):
        return self.derivatives(t, 0)[0]

    def interval(self):
        return _interval(self.basis, self.closed)

    def homogeneous(self) -> Float[Array, "n d+1"]:
        """The points (w P, w) of the curve before the division."""
        return _homogeneous(self.control, self.weights)

    def derivatives(self, t: Float[Array, ""], order: int) -> Float[Array, "r d"]:
        """The point and its first `order` derivatives, rows 0 to `order`.

        Exact through the basis and the quotient rule (Piegl, Tiller 1997, eq. 4.8). At
        a knot those from the right.
        """
        t = floating(t)
        rows = self.basis.derivatives(t, order) @ self.homogeneous()
        out = []
        for k in range(order + 1):
            rest = sum(comb(k, i) * rows[i, -1] * out[k - i] for i in range(1, k + 1))
            out.append((rows[k, :-1] - rest) / rows[0, -1])
        return jnp.stack(out)


class NurbsSurface(AbstractSurface):
    """X(u, v) = sum N_i(u) M_j(v) w_ij P_ij / sum N_i(u) M_j(v) w_ij.

    **Arguments:**

    - `control` [n, m, 3]: the net of control points P_ij.
    - `bases`: the functions N_i and M_j: knots and degrees, static.
    - `weights` [n, m]: positive; one by default.
    - `closed`: whether the end in (u, v) is the begin, and the surface goes on there.
    - `poles`: for u and for v, whether the (low, high) side is one point.

    Raises `GeometryError` for shapes that do not fit the bases and for weights that are
    not positive (where they are known).
    """

    control: Float[Array, "n m 3"]
    weights: Float[Array, "n m"]
    bases: tuple[SplineBasis, SplineBasis]
    closed: tuple[bool, bool] = eqx.field(static=True)
    poles: tuple[tuple[bool, bool], tuple[bool, bool]] = eqx.field(static=True)

    def __init__(
        self,
        control,
        bases: tuple[SplineBasis, SplineBasis],
        weights=None,
        *,
        closed=(False, False),
        poles=((False, False), (False, False)),
    ):
        self.control = floating(control)
        self.bases = tuple(bases)
        self.closed, self.poles = tuple(closed), tuple(tuple(p) for p in poles)
        check_shape("control", self.control, (None, None, 3))
        self.weights = _weights(weights, self.control)
        for axis, basis in enumerate(self.bases):
            _check_fit(f"axis {axis} of control", self.control.shape[axis], basis)

    def evaluate(self, uv):
        (i, (a,)), (j, (b,)) = (
            basis.local(t) for basis, t in zip(self.bases, uv, strict=True)
        )
        net = self.homogeneous()
        if net.shape[0] * net.shape[1] <= _DENSE:
            across = jnp.tensordot(self.bases[0].spread(i, a), net, 1)
            point = self.bases[1].spread(j, b) @ across
        else:
            point = _gathered(net, (i, j), (a, b))
        return point[:-1] / point[-1]

    def domain(self):
        sides = zip(self.bases, self.closed, self.poles, strict=True)
        return Domain(*(_interval(*side) for side in sides))

    def homogeneous(self) -> Float[Array, "n m 4"]:
        """The points (w P, w) of the surface before the division."""
        return _homogeneous(self.control, self.weights)

    def derivatives(self, uv: Float[Array, " 2"], order: int) -> Float[Array, "r s 3"]:
        """The derivatives d^(k + l) X / du^k dv^l for k, l <= `order`, at [k, l].

        Exact through the bases and the quotient rule (Piegl, Tiller 1997, eq. 4.20). At
        a knot those from the right.
        """
        uv = floating(uv)
        rows, columns = (
            basis.derivatives(t, order) for basis, t in zip(self.bases, uv, strict=True)
        )
        net = self.homogeneous()
        # One product after the other: batches of small matrices are slow on a CPU.
        across = [jnp.tensordot(row, net, 1) for row in rows]
        table = [[column @ part for column in columns] for part in across]
        out = [[None] * (order + 1) for _ in range(order + 1)]
        for k in range(order + 1):
            for m in range(order + 1):
                rest = _rest(table, out, k, m)
                out[k][m] = (table[k][m][:-1] - rest) / table[0][0][-1]
        return jnp.stack([jnp.stack(row) for row in out])


def _rest(table, out, k, m):
    """What the derivatives of the weight take from the derivative [k, m]."""
    below = [(i, j) for i in range(k + 1) for j in range(m + 1) if i or j]
    return sum(
        comb(k, i) * comb(m, j) * table[i][j][-1] * out[k - i][m - j] for i, j in below
    )


def _gathered(net, first, factors):
    """sum a_i b_j net[i, j], number by number: large gathers are slow on a CPU."""
    flat = net.reshape(-1, net.shape[-1]).T
    starts = [(first[0] + i) * net.shape[1] + first[1] for i in range(len(factors[0]))]
    terms = [
        (a * b, start + j)
        for a, start in zip(factors[0], starts, strict=True)
        for j, b in enumerate(factors[1])
    ]
    return jnp.stack([sum(c * column[k] for c, k in terms) for column in flat])


def _homogeneous(control, weights):
    return jnp.concatenate([control * weights[..., None], weights[..., None]], axis=-1)


def from_homogeneous(points: Float[Array, "*n d+1"]):
    """The control points and the weights of points (w P, w)."""
    return points[..., :-1] / points[..., -1:], points[..., -1]


def _interval(basis, closed, poles=(False, False)):
    return Interval(
        basis.low, basis.high, periodic=closed, poles=poles, breaks=basis.breaks
    )


def _weights(weights, control):
    shape = control.shape[:-1]
    if weights is None:
        return jnp.ones(shape, control.dtype)
    weights = floating(weights)
    check_shape("weights", weights, shape)
    known = not isinstance(weights, jax.core.Tracer)
    if known and not (np.asarray(weights) > 0).all():
        given = f"a least weight of {np.min(np.asarray(weights))}"
        raise GeometryError(message("weights must be positive", given, "Raise them."))
    return weights


def _check_fit(name, number, basis):
    if number != basis.num_control:
        must = f"{name} must have {basis.num_control} points, for {len(basis.knots)} "
        must += f"knots of degree {basis.degree}"
        raise GeometryError(message(must, f"{number}", "Match points and knots."))
