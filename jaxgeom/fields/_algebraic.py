"""Algebraic surfaces from coefficients."""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, message
from ._claims import IMPLICIT_ONLY, Bounds, Claims
from ._conditioned import Conditioned
from ._field import AbstractField
from ._parameters import array, vector


class Polynomial(AbstractField):
    """sum_i coefficient_i x^a_i y^b_i z^c_i, `exponents` (a, b, c) static.

    Implicit only, without a Lipschitz constant; `within(low, high)` makes it a lower
    bound of the distance in a box.
    """

    coefficients: Float[Array, " m"] = eqx.field(converter=array("coefficients", None))
    exponents: tuple[tuple[int, int, int], ...] = eqx.field(static=True)

    def __check_init__(self):
        if len(self.exponents) != self.coefficients.shape[0]:
            raise GeometryError(
                message(
                    "a polynomial needs one coefficient for each triple of exponents",
                    f"{self.coefficients.shape[0]} coefficients, "
                    f"{len(self.exponents)} exponents",
                    "Write it as Polynomial.of(lambda x, y, z: ...).",
                )
            )

    @staticmethod
    def of(formula: Callable) -> "Polynomial":
        """From a formula in + - * ** of three symbols and numbers (or scalar arrays).

        `Polynomial.of(lambda x, y, z: x**2 + y**2 + z**2 - 1)`.
        """
        terms = formula(*(_Terms({e: 1.0}) for e in ((1, 0, 0), (0, 1, 0), (0, 0, 1))))
        exponents = tuple(sorted(terms.table))
        numbers = [jnp.asarray(terms.table[e], float) for e in exponents]
        return Polynomial(jnp.stack(numbers), exponents)

    def evaluate(self, point):
        powers = [_powers(point[d], self._degree(d)) for d in range(3)]
        a, b, c = np.array(self.exponents).T
        products = powers[0][a] * powers[1][b] * powers[2][c]
        return jnp.dot(self.coefficients, products)

    def claims(self):
        space = Bounds.everywhere()
        return Claims(jnp.full((), jnp.inf), IMPLICIT_ONLY, space, space)

    def within(self, low, high, *, parts: int = 4) -> Conditioned:
        """The body cut off by a box, as a lower bound of the distance (`Conditioned`).

        The bound of the second derivatives is that of their Bernstein coefficients on
        `parts`^3 boxes.
        """
        low, high = vector("low")(low), vector("high")(high)
        return Conditioned(self, self.curvature(low, high, parts=parts), low, high)

    def derivative(self, axis: int) -> "Polynomial":
        """The partial derivative along an axis."""
        factors = np.array([e[axis] for e in self.exponents], float)
        lower = tuple(
            tuple(max(n - (d == axis), 0) for d, n in enumerate(e))
            for e in self.exponents
        )
        factors = jnp.asarray(factors, self.coefficients.dtype)
        return Polynomial(self.coefficients * factors, lower)

    def curvature(self, low, high, *, parts: int = 4) -> Float[Array, ""]:
        """A bound of the norm of the Hessian in a box: the root of the sum of squares
        of bounds of its entries, the largest over `parts`^3 boxes."""
        total = jnp.zeros(())
        for i in range(3):
            for j in range(i, 3):
                second = self.derivative(i).derivative(j)
                bound = second.largest(low, high, parts=parts)
                total = total + (1 if i == j else 2) * bound**2
        return jnp.sqrt(jnp.max(total))

    def largest(self, low, high, *, parts: int = 4) -> Float[Array, "p p p"]:
        """A bound of the absolute value in each of `parts`^3 boxes that fill a box.

        A polynomial on a box lies between its least and its largest Bernstein
        coefficient there.
        """
        shape = [self._degree(d) + 1 for d in range(3)]
        dense = jnp.zeros(shape, self.coefficients.dtype)
        dense = dense.at[tuple(np.array(self.exponents).T)].add(self.coefficients)
        steps = (high - low) / parts
        maps = []
        for d in range(3):
            starts = low[d] + steps[d] * jnp.arange(parts, dtype=low.dtype)
            maps.append(_bernstein(self._degree(d), starts, steps[d]))
        found = jnp.einsum("pia,qjb,rkc,abc->pqrijk", *maps, dense)
        return jnp.max(jnp.abs(found), axis=(3, 4, 5))

    def _degree(self, axis):
        return max(e[axis] for e in self.exponents)


class _Terms:
    """A polynomial while it is written: a table from exponents to coefficients."""

    def __init__(self, table):
        self.table = table

    def __add__(self, other):
        table = dict(self.table)
        for e, c in _terms(other).table.items():
            table[e] = table[e] + c if e in table else c
        return _Terms(table)

    def __mul__(self, other):
        table = {}
        for e, c in self.table.items():
            for f, d in _terms(other).table.items():
                key = (e[0] + f[0], e[1] + f[1], e[2] + f[2])
                table[key] = table[key] + c * d if key in table else c * d
        return _Terms(table)

    def __pow__(self, power: int):
        return math.prod([self] * power, start=_Terms({(0, 0, 0): 1.0}))

    def __neg__(self):
        return self * -1.0

    def __sub__(self, other):
        return self + -_terms(other)

    def __rsub__(self, other):
        return _terms(other) - self

    def __truediv__(self, number):
        return self * (1 / number)

    __radd__, __rmul__ = __add__, __mul__


def _terms(x) -> _Terms:
    return x if isinstance(x, _Terms) else _Terms({(0, 0, 0): x})


def _powers(x, degree):
    """1, x, ..., x^degree, by products: their derivatives at 0 are finite."""
    powers = [jnp.ones_like(x)]
    for _ in range(degree):
        powers.append(powers[-1] * x)
    return jnp.stack(powers)


def _bernstein(degree, starts, step) -> Float[Array, "p n m"]:
    """From coefficients of powers of x to Bernstein coefficients on [s, s + step].

    x = s + step u: x^a = sum_m C(a, m) s^(a-m) step^m u^m, and u^m has the Bernstein
    coefficients C(i, m) / C(degree, m).
    """
    n = degree + 1
    binomial = np.array([[math.comb(i, m) for m in range(n)] for i in range(n)], float)
    to_bernstein = jnp.asarray(binomial / binomial[-1], starts.dtype)
    rows = jnp.stack([_powers(s, degree) for s in starts])
    gap = np.arange(n)[None] - np.arange(n)[:, None]
    shifted = jnp.where(gap >= 0, rows[:, np.maximum(gap, 0)], 0)
    scale = _powers(step, degree)[:, None] * jnp.asarray(binomial.T, starts.dtype)
    return jnp.einsum("im,pma->pia", to_bernstein, shifted * scale)
