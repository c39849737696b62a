"""Subdivision curves against scipy's B-splines, polynomials and hand-worked masks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline

from jaxgeom import GeometryError
from jaxgeom.subdivision import (
    Chaikin,
    Closed,
    FourPoint,
    FreeEnds,
    KeptEnds,
    LaneRiesenfeld,
    curve_limit,
    curve_refinement,
    subdivide_curve,
)

ENDS = {"closed": Closed(), "free": FreeEnds(), "kept": KeptEnds()}
SCHEMES = {
    "chaikin": Chaikin(),
    "four-point": FourPoint(),
    "degree 1": LaneRiesenfeld(1),
    "degree 3": LaneRiesenfeld(3),
    "degree 4": LaneRiesenfeld(4),
    "degree 5": LaneRiesenfeld(5),
}
EVERY_END = pytest.mark.parametrize("ends", ENDS.values(), ids=ENDS.keys())
EVERY_SCHEME = pytest.mark.parametrize("scheme", SCHEMES.values(), ids=SCHEMES.keys())


def points(n=9, d=3):
    return np.random.default_rng(n).normal(size=(n, d))


def matrix(n, levels, scheme, ends):
    return curve_refinement(n, levels, scheme=scheme, ends=ends).to_scipy()


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5, 6])
def test_lane_riesenfeld_is_the_uniform_spline(x64, degree):
    n, levels = 9, 3
    coarse = BSpline(np.arange(n + degree + 1.0), points(n), degree)
    fine = matrix(n, levels, LaneRiesenfeld(degree), FreeEnds()) @ points(n)
    knots = degree + 2.0**-levels * (np.arange(len(fine) + degree + 1) - degree)
    assert knots[len(fine)] == n
    t = np.linspace(degree, n, 40, endpoint=False)
    np.testing.assert_allclose(BSpline(knots, fine, degree)(t), coarse(t), atol=1e-14)
    limits = curve_limit(n, scheme=LaneRiesenfeld(degree), ends=FreeEnds())
    reach = degree // 2
    centers = np.arange(reach, n - reach) + (degree + 1) / 2
    np.testing.assert_allclose(
        limits.to_scipy() @ points(n), coarse(centers), atol=1e-14
    )


@pytest.mark.parametrize("degree", [2, 3, 5])
def test_closed_curves_are_periodic_splines(x64, degree):
    n, levels = 7, 2
    wrapped = np.concatenate([points(n)] * 3)
    long = matrix(3 * n, levels, LaneRiesenfeld(degree), FreeEnds()) @ wrapped
    closed = matrix(n, levels, LaneRiesenfeld(degree), Closed()) @ points(n)
    count = len(closed)
    assert count == 4 * n
    start = np.argmin(np.linalg.norm(long[:count] - closed[0], axis=1))
    np.testing.assert_allclose(long[start : start + count], closed, atol=1e-14)


def test_masks_by_hand(x64):
    p = points(4)
    a, b, c, d = p
    cut = matrix(4, 1, Chaikin(), KeptEnds()) @ p
    quarter = lambda x, y: (3 * x + y) / 4
    want = [quarter(a, b), quarter(b, a), quarter(b, c), quarter(c, b)]
    np.testing.assert_allclose(cut, [a, *want, quarter(c, d), quarter(d, c), d])
    spline = matrix(4, 1, LaneRiesenfeld(3), KeptEnds()) @ p
    old = [a, (a + 6 * b + c) / 8, (b + 6 * c + d) / 8, d]
    np.testing.assert_allclose(spline[::2], old)
    np.testing.assert_allclose(spline[1::2], [(a + b) / 2, (b + c) / 2, (c + d) / 2])
    through = matrix(4, 1, FourPoint(), Closed()) @ p
    np.testing.assert_allclose(through[::2], p)
    np.testing.assert_allclose(through[1], (-d + 9 * a + 9 * b - c) / 16)


def test_four_point_at_kept_ends_by_hand(x64):
    p = points(5)
    fine = matrix(5, 1, FourPoint(), KeptEnds()) @ p
    first = (5 * p[0] + 15 * p[1] - 5 * p[2] + p[3]) / 16
    np.testing.assert_allclose(fine[1], first)


@pytest.mark.parametrize("ends", [FreeEnds(), KeptEnds()], ids=["free", "kept"])
def test_four_point_reproduces_cubics(x64, ends):
    powers = np.arange(8.0)[:, None] ** np.arange(4)
    fine = matrix(8, 4, FourPoint(), ends) @ powers
    np.testing.assert_allclose(fine, fine[:, 1:2] ** np.arange(4), rtol=1e-12)
    kept = isinstance(ends, KeptEnds)
    np.testing.assert_allclose(fine[[0, -1], 1], [0, 7] if kept else [1.875, 5.125])


@pytest.mark.parametrize("degree", [1, 2, 3, 4, 5])
def test_lane_riesenfeld_keeps_lines_evenly_spaced(x64, degree):
    fine = matrix(10, 3, LaneRiesenfeld(degree), FreeEnds()) @ np.arange(10.0)
    np.testing.assert_allclose(np.diff(fine), 1 / 8, atol=1e-13)


@EVERY_END
@EVERY_SCHEME
def test_laws(x64, scheme, ends):
    s = matrix(9, 3, scheme, ends)
    np.testing.assert_allclose(s.sum(axis=1), 1, atol=1e-13)
    turned = matrix(9, 3, scheme, ends) @ points()[::-1]
    if not isinstance(ends, Closed):
        np.testing.assert_allclose(turned, (s @ points())[::-1], atol=1e-13)
    if isinstance(ends, KeptEnds):
        np.testing.assert_allclose((s @ points())[[0, -1]], points()[[0, -1]])


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_limits_of_kept_ends(x64, degree):
    scheme = LaneRiesenfeld(degree)
    limits = curve_limit(9, scheme=scheme, ends=KeptEnds()).to_scipy() @ points()
    np.testing.assert_allclose(limits[[0, -1]], points()[[0, -1]], atol=1e-14)
    deep = matrix(9, 12, scheme, KeptEnds()) @ points()
    near = np.linalg.norm(deep[:, None] - limits, axis=-1).min(axis=0)
    # Points lie 2^-12 apart on a curve of speed about 3.
    assert near.max() < 1e-3
    if degree % 2:
        index = 2**12 * np.arange(9)
        np.testing.assert_allclose(deep[index], limits, atol=1e-6)


def test_curves_are_jitted_batched_and_differentiated(x64):
    s = curve_refinement(6, 2, scheme=LaneRiesenfeld(3))
    many = np.random.default_rng(0).normal(size=(3, 6, 2))
    length = lambda p: jnp.sum((s @ p - jnp.roll(s @ p, 1, axis=0)) ** 2)
    slope = jax.jit(jax.vmap(jax.grad(length)))(many)
    dense = s.to_scipy().toarray()
    sides = dense - np.roll(dense, 1, axis=0)
    np.testing.assert_allclose(slope, 2 * sides.T @ sides @ many, atol=1e-13)
    np.testing.assert_allclose(
        subdivide_curve(many[0], 2, scheme=LaneRiesenfeld(3)), dense @ many[0]
    )


def test_bad_curves_are_errors():
    with pytest.raises(GeometryError, match="at least 4 points"):
        curve_refinement(3, scheme=FourPoint(), ends=KeptEnds())
    with pytest.raises(GeometryError, match="at least 3 points"):
        curve_refinement(2, scheme=Chaikin())
    with pytest.raises(GeometryError, match="at least 2 points"):
        curve_refinement(2, scheme=LaneRiesenfeld(5), ends=FreeEnds())
    with pytest.raises(GeometryError, match="degree must be at least 1"):
        LaneRiesenfeld(0)
    with pytest.raises(GeometryError, match="levels must be at least 0"):
        curve_refinement(5, -1)
    with pytest.raises(GeometryError, match="known for degree 2 and odd"):
        curve_limit(9, scheme=LaneRiesenfeld(4), ends=KeptEnds())
