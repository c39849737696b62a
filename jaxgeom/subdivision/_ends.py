"""What subdivision curves do where the control polygon begins and ends (host)."""

import abc

import equinox as eqx
import numpy as np
from scipy import sparse

from .._core import GeometryError, message


class AbstractEnds(eqx.Module):
    """The end rule of a control polygon, as matrices of its steps."""

    @abc.abstractmethod
    def linear(self, n: int) -> sparse.csr_matrix:
        """The points and the middles between them, in order."""

    @abc.abstractmethod
    def average(self, m: int, turn: int) -> sparse.csr_matrix:
        """The middles of neighbors after `linear` and `turn` such averages."""

    @abc.abstractmethod
    def four_point(self, n: int, w: float) -> sparse.csr_matrix:
        """The points, and between them -w, 1/2 + w, 1/2 + w, -w of the nearest four."""

    @abc.abstractmethod
    def centered(self, n: int, mask, is_dual: bool) -> sparse.csr_matrix:
        """An odd mask applied at the points; `is_dual` for schemes of even degree."""


class Closed(AbstractEnds):
    """The last point is followed by the first: n points become 2 n."""

    def linear(self, n):
        """2 n rows."""
        _check(n, 3)
        return _interleave(sparse.eye(n), _wrapped(n, {0: 0.5, 1: 0.5}))

    def average(self, m, turn):
        """m rows; forward and backward in turn, so that points keep their place."""
        return _wrapped(m, {0: 0.5, 1 if turn % 2 == 0 else -1: 0.5})

    def four_point(self, n, w):
        """2 n rows."""
        _check(n, 3)
        between = _wrapped(n, {-1: -w, 0: 0.5 + w, 1: 0.5 + w, 2: -w})
        return _interleave(sparse.eye(n), between)

    def centered(self, n, mask, is_dual):
        """n rows."""
        reach = len(mask) // 2
        return _wrapped(n, {j - reach: x for j, x in enumerate(mask)})


class FreeEnds(AbstractEnds):
    """Only points whose whole mask exists: the curve ends before its polygon.

    Lane-Riesenfeld of degree d takes n points to 2 n - d and gives the uniform B-spline
    of these control points on its n - d full spans; four-point takes n to 2 n - 5 and
    gives the curve from point 2 to point n - 3.
    """

    def linear(self, n):
        """2 n - 1 rows."""
        _check(n, 2)
        return _interleave(sparse.eye(n), _cut(n, [0.5, 0.5]))

    def average(self, m, turn):
        """m - 1 rows."""
        _check(m, 2)
        return _cut(m, [0.5, 0.5])

    def four_point(self, n, w):
        """2 n - 5 rows."""
        _check(n, 6)
        inner = sparse.eye(n, format="csr")[1:-1]
        return _interleave(inner, _cut(n, [-w, 0.5 + w, 0.5 + w, -w]))

    def centered(self, n, mask, is_dual):
        """One row for each point that has all of its neighbors."""
        _check(n, len(mask))
        return _cut(n, mask)


class KeptEnds(AbstractEnds):
    """The first and the last point stay: the curve goes from one to the other.

    Lane-Riesenfeld: every averaging step leaves out the ends and puts them back. For
    degree 3 that is the B-spline continued by the phantom points 2 P_0 - P_1 (no
    curvature at the ends), for degree 2 (Chaikin) by P_0 itself. Four-point: continued
    by the cubic through the last four points. n points become 2 n - 1, or 2 n for even
    degrees.
    """

    def linear(self, n):
        """2 n - 1 rows."""
        _check(n, 2)
        return _interleave(sparse.eye(n), _cut(n, [0.5, 0.5]))

    def average(self, m, turn):
        """m + 1 rows, or m - 1 for every second turn, which has the ends apart."""
        ends = sparse.eye(m, format="csr")[[0, m - 1]]
        inner = _cut(m, [0.5, 0.5])
        return _between(ends, inner if turn % 2 == 0 else inner[1:-1])

    def four_point(self, n, w):
        """2 n - 1 rows."""
        _check(n, 4)
        last = np.array([[4, -6, 4, -1.0]])
        none = np.zeros((1, n - 4))
        phantoms = (
            np.concatenate([last, none], 1),
            np.concatenate([none, last[:, ::-1]], 1),
        )
        longer = _between(sparse.csr_matrix(np.concatenate(phantoms)), sparse.eye(n))
        between = _cut(n + 2, [-w, 0.5 + w, 0.5 + w, -w]) @ longer
        return _interleave(sparse.eye(n), between)

    def centered(self, n, mask, is_dual):
        """n rows, continued by 2 P_0 - P_i; of even degrees only 2 is known."""
        reach = len(mask) // 2
        if is_dual and reach > 1:
            must = "limits of kept ends are known for degree 2 and odd degrees"
            fix = "Use Closed() or FreeEnds()."
            raise GeometryError(message(must, f"degree {2 * reach}", fix))
        _check(n, reach + 1)
        longer = sparse.lil_matrix((n + 2 * reach, n))
        longer[reach : reach + n] = sparse.eye(n)
        for i in range(1, reach + 1):
            longer[reach - i, 0] = longer[n + reach - 1 + i, n - 1] = 2
            longer[reach - i, i] = longer[n + reach - 1 + i, n - 1 - i] = -1
        return _cut(n + 2 * reach, mask) @ longer.tocsr()


def _cut(n, mask):
    """The mask at every place where all of it lies inside."""
    m = max(n - len(mask) + 1, 0)
    return sparse.diags(list(mask), range(len(mask)), shape=(m, n), format="csr")


def _wrapped(n, mask):
    """The mask {offset: weight} on a closed polygon."""
    i = np.arange(n)
    parts = [
        sparse.csr_matrix((np.full(n, x), (i, (i + j) % n))) for j, x in mask.items()
    ]
    return sum(parts[1:], parts[0])


def _interleave(even, odd):
    """The rows of two matrices in turn, beginning with those of the first."""
    stacked = sparse.vstack([even, odd], "csr")
    place = np.concatenate(
        [2 * np.arange(even.shape[0]), 2 * np.arange(odd.shape[0]) + 1]
    )
    return stacked[np.argsort(place)]


def _between(ends, inner):
    return sparse.vstack([ends[0], inner, ends[1]], "csr")


def _check(n, least):
    if n < least:
        must = f"the control polygon must have at least {least} points here"
        raise GeometryError(message(must, f"{n}", "Add points, or use other ends."))
