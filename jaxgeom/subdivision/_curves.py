"""Subdivision curves: control polygons refined by linear operators."""

import abc

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.interpolate import BSpline

from .._core import GeometryError, message
from ._ends import AbstractEnds, Closed
from ._operator import Refinement, Rows, band_of, on_device

CLOSED = Closed()


class AbstractCurveScheme(eqx.Module):
    """A rule that takes a control polygon to a finer one."""

    @abc.abstractmethod
    def matrix(self, n: int, ends: AbstractEnds) -> sparse.csr_matrix:
        """One level for n points (host)."""

    @abc.abstractmethod
    def limit(self, n: int, ends: AbstractEnds) -> sparse.csr_matrix:
        """The points of the limit curve that belong to the points (host)."""


class LaneRiesenfeld(AbstractCurveScheme):
    """The uniform B-spline of a degree: middles inserted, then degree - 1 averages.

    Degree 1 is the polygon itself, 2 Chaikin's corner cutting, 3 the cubic with masks
    1/2, 1/2 and 1/8, 6/8, 1/8; the limit is C^(degree - 1).

    Source: J. Lane, R. Riesenfeld, A theoretical development for the computer
    generation of piecewise polynomial surfaces, 1980.
    """

    degree: int = eqx.field(default=3, static=True)

    def __check_init__(self):
        if self.degree < 1:
            must = "degree must be at least 1"
            raise GeometryError(message(must, f"{self.degree}", "Use 3 for cubics."))

    def matrix(self, n, ends):
        """One level for n points (host)."""
        return _averaged(n, ends, self.degree)

    def limit(self, n, ends):
        """The B-spline at the middles of the basis functions (host)."""
        return _spline_limit(n, ends, self.degree)


class Chaikin(AbstractCurveScheme):
    """Corner cutting: 3/4, 1/4 and 1/4, 3/4 of every edge; the quadratic B-spline.

    Source: G. Chaikin, An algorithm for high-speed curve generation, 1974.
    """

    def matrix(self, n, ends):
        """One level for n points (host)."""
        return _averaged(n, ends, 2)

    def limit(self, n, ends):
        """1/8, 6/8, 1/8 (host)."""
        return _spline_limit(n, ends, 2)


class FourPoint(AbstractCurveScheme):
    """The curve through the points: new ones are -w, 1/2 + w, 1/2 + w, -w of four.

    With w = 1/16 it reproduces cubics and is C1; it is C1 for 0 < w < 0.1927, and the
    polygon for w = 0.

    Source: N. Dyn, D. Levin, J. Gregory, A 4-point interpolatory subdivision scheme for
    curve design, 1987.
    """

    w: float = eqx.field(default=1 / 16, static=True)

    def matrix(self, n, ends):
        """One level for n points (host)."""
        return ends.four_point(n, self.w)

    def limit(self, n, ends):
        """The points themselves (host)."""
        return ends.centered(n, [0, 0, 1, 0, 0], False)


CHAIKIN = Chaikin()


def curve_refinement(
    n: int,
    levels: int = 1,
    *,
    scheme: AbstractCurveScheme = CHAIKIN,
    ends: AbstractEnds = CLOSED,
) -> Refinement:
    """The operator from n control points to those of a finer polygon (host).

    Raises `GeometryError` for fewer points than the scheme needs at these ends and for
    a negative number of levels.
    """
    if levels < 0:
        must = "levels must be at least 0"
        raise GeometryError(message(must, f"{levels}", "Pass a whole number."))
    matrices = [] if levels else [sparse.eye(n, format="csr")]
    for _ in range(levels):
        matrices.append(scheme.matrix(n, ends))
        n = matrices[-1].shape[0]
    return Refinement(on_device(tuple(_rows(x) for x in matrices)))


def curve_limit(
    n: int, *, scheme: AbstractCurveScheme = CHAIKIN, ends: AbstractEnds = CLOSED
) -> Refinement:
    """The operator from n control points to points of the limit curve (host).

    One row for each control point, where its basis function is largest; with
    `FreeEnds` for each whose neighbors all exist.
    """
    return Refinement(on_device((_rows(scheme.limit(n, ends)),)))


def subdivide_curve(
    points: Float[jax.Array, "n ..."],
    levels: int = 1,
    *,
    scheme: AbstractCurveScheme = CHAIKIN,
    ends: AbstractEnds = CLOSED,
) -> Float[jax.Array, "m ..."]:
    """The control polygon `points` after `levels` levels of refinement.

    x_fine = S x, S being `curve_refinement`, for points of any dimension.

    **Arguments:** `scheme`: `Chaikin()`, `FourPoint()`, `LaneRiesenfeld(degree)`;
    `ends`: `Closed()`, `KeptEnds()`, `FreeEnds()`.

    Raises `GeometryError` as `curve_refinement`.

    >>> square = jax.numpy.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])
    >>> subdivide_curve(square)[:2].tolist()
    [[1.0, 0.0], [3.0, 0.0]]
    """
    n = points.shape[0]
    return curve_refinement(n, levels, scheme=scheme, ends=ends) @ points


def _averaged(n, ends, degree):
    matrix = ends.linear(n)
    for turn in range(degree - 1):
        matrix = ends.average(matrix.shape[0], turn) @ matrix
    return matrix


def _spline_limit(n, ends, degree):
    reach = degree // 2
    basis = BSpline.basis_element(np.arange(degree + 2) - (degree + 1) / 2, False)
    values = basis(np.arange(-reach, reach + 1.0))
    return ends.centered(n, np.nan_to_num(values), degree % 2 == 0)


def _rows(matrix) -> Rows:
    return Rows((band_of(matrix.tocsr()),), matrix.shape[1])
