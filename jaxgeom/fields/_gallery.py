"""Famous algebraic surfaces, as polynomials; `within(low, high)` bounds them.

Sources: G. Fischer, Mathematical models (1986); B. Taubin's heart (1994); Barth (1996).
"""

import math

from ._algebraic import Polynomial

_GOLDEN = (1 + math.sqrt(5)) / 2


def algebraic_sphere(radius=1.0) -> Polynomial:
    """x^2 + y^2 + z^2 - radius^2."""
    return Polynomial.of(lambda x, y, z: x**2 + y**2 + z**2 - radius**2)


def algebraic_torus(major=0.7, minor=0.3) -> Polynomial:
    """(x^2 + y^2 + z^2 + R^2 - r^2)^2 - 4 R^2 (x^2 + y^2)."""
    inner = major**2 - minor**2
    return Polynomial.of(
        lambda x, y, z: (x**2 + y**2 + z**2 + inner) ** 2 - 4 * major**2 * (x**2 + y**2)
    )


def heart() -> Polynomial:
    """Taubin's (x^2 + 9/4 y^2 + z^2 - 1)^3 - x^2 z^3 - 9/80 y^2 z^3, within 1.4."""
    return Polynomial.of(
        lambda x, y, z: (
            (x**2 + 9 / 4 * y**2 + z**2 - 1) ** 3 - x**2 * z**3 - 9 / 80 * y**2 * z**3
        )
    )


def cayley_cubic() -> Polynomial:
    """x^2 + y^2 + z^2 + 2xyz - 1: four nodes at (1, 1, -1), ..., unbounded."""
    return Polynomial.of(lambda x, y, z: x**2 + y**2 + z**2 + 2 * x * y * z - 1)


def clebsch_cubic() -> Polynomial:
    """The diagonal cubic x^3 + y^3 + z^3 + 1 - (x + y + z + 1)^3: 27 real lines."""
    return Polynomial.of(lambda x, y, z: x**3 + y**3 + z**3 + 1 - (x + y + z + 1) ** 3)


def kummer_quartic(mu=1.3) -> Polynomial:
    """(x^2 + y^2 + z^2 - mu^2)^2 - l p q r s: 16 nodes for 1 < mu^2 < 3.

    l = (3 mu^2 - 1) / (3 - mu^2), and p, q, r, s = 1 - z +- sqrt(2) x, 1 + z +-
    sqrt(2) y are the planes of a tetrahedron.
    """
    square = mu**2
    factor = (3 * square - 1) / (3 - square)
    root = math.sqrt(2)
    return Polynomial.of(
        lambda x, y, z: (
            (x**2 + y**2 + z**2 - square) ** 2
            - factor
            * ((1 - z) ** 2 - (root * x) ** 2)
            * ((1 + z) ** 2 - (root * y) ** 2)
        )
    )


def barth_sextic() -> Polynomial:
    """The sextic with 65 nodes, the most it can have; p is the golden ratio.

    4 (p^2 x^2 - y^2)(p^2 y^2 - z^2)(p^2 z^2 - x^2) - (1 + 2p)(x^2 + y^2 + z^2 - 1)^2.
    """
    p = _GOLDEN**2
    return Polynomial.of(
        lambda x, y, z: (
            4 * (p * x**2 - y**2) * (p * y**2 - z**2) * (p * z**2 - x**2)
            - (1 + 2 * _GOLDEN) * (x**2 + y**2 + z**2 - 1) ** 2
        )
    )


def chmutov(degree: int = 4, level=1.0) -> Polynomial:
    """T_n(x) + T_n(y) + T_n(z) + level, T_n the Chebyshev polynomial of degree n.

    With level 1 (n even) or 0 it has many nodes, in |x|, |y|, |z| <= 1.
    """

    def chebyshev(x):
        before, now = x**0, x
        for _ in range(degree - 1):
            before, now = now, 2 * x * now - before
        return now

    return Polynomial.of(
        lambda x, y, z: chebyshev(x) + chebyshev(y) + chebyshev(z) + level
    )


def dupin_cyclide(a=1.0, b=0.95, d=0.5) -> Polynomial:
    """(x^2 + y^2 + z^2 + b^2 - d^2)^2 - 4 (a x - c d)^2 - 4 b^2 y^2, c^2 = a^2 - b^2.

    A ring whose tube grows and shrinks, for c < d < a; a = b is the torus.
    """
    shift = (a**2 - b**2) ** 0.5 * d
    return Polynomial.of(
        lambda x, y, z: (
            (x**2 + y**2 + z**2 + b**2 - d**2) ** 2
            - 4 * (a * x - shift) ** 2
            - 4 * b**2 * y**2
        )
    )


def tanglecube() -> Polynomial:
    """x^4 - 5x^2 + y^4 - 5y^2 + z^4 - 5z^2 + 11.8 (Goursat), within 2.5."""
    quartic = lambda x: x**4 - 5 * x**2
    return Polynomial.of(lambda x, y, z: quartic(x) + quartic(y) + quartic(z) + 11.8)


def steiner_roman() -> Polynomial:
    """x^2 y^2 + y^2 z^2 + z^2 x^2 - 2xyz: three double lines through a triple point."""
    return Polynomial.of(
        lambda x, y, z: x**2 * y**2 + y**2 * z**2 + z**2 * x**2 - 2 * x * y * z
    )


def ding_dong() -> Polynomial:
    """x^2 + y^2 - (1 - z) z^2: a drop with a node at the origin, open downwards."""
    return Polynomial.of(lambda x, y, z: x**2 + y**2 - (1 - z) * z**2)
