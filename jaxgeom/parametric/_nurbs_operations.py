"""Knot insertion, degree elevation, splitting and reversal of NURBS.

Each is a linear map of the homogeneous control points that is planned on the host from
the static knots, so that it can be jitted, mapped and differentiated in the points and
the weights. `axis` is 0 for u and for curves, 1 for v.
"""

import jax
import jax.numpy as jnp

from .._core import GeometryError, message
from ._nurbs import NurbsCurve, NurbsSurface, from_homogeneous
from ._spline_maps import (
    SplineMap,
    bezier_pieces,
    elevation,
    insertion,
    reversal,
    splitting,
)
from ._splines import SplineBasis

_WHOLE = (False, False)


def insert_knots(shape: NurbsCurve | NurbsSurface, knots, *, axis: int = 0):
    """The same curve or surface with the knots [k] added along `axis`.

    Raises `GeometryError` for knots outside the domain or too often repeated.
    Source: W. Boehm, Inserting new knots into B-spline curves, 1980.
    """
    return mapped(shape, insertion(_basis(shape, axis), knots), axis=axis)


def elevate_degree(shape: NurbsCurve | NurbsSurface, times: int = 1, *, axis: int = 0):
    """The same curve or surface with a degree higher by `times` along `axis`.

    Raises `GeometryError` for a negative number.
    """
    return mapped(shape, elevation(_basis(shape, axis), times), axis=axis)


def reverse(shape: NurbsCurve | NurbsSurface, *, axis: int = 0):
    """The same curve or surface run through backwards along `axis`, same domain.

    The normal of a surface turns over.
    """
    out = mapped(shape, reversal(_basis(shape, axis)), axis=axis)
    if isinstance(shape, NurbsCurve):
        return out
    poles = _with(out.poles, axis, out.poles[axis][::-1])
    return NurbsSurface(
        out.control, out.bases, out.weights, closed=out.closed, poles=poles
    )


def split(shape: NurbsCurve | NurbsSurface, at: float, *, axis: int = 0):
    """The two parts of a curve or surface before and after the parameter `at`.

    They keep their parameters. Raises `GeometryError` unless `at` lies strictly inside
    the domain.
    """
    before, after = splitting(_basis(shape, axis), at)
    parts = mapped(shape, before, axis=axis), mapped(shape, after, axis=axis)
    return tuple(_opened(part, end, axis) for end, part in enumerate(parts))


def bezier(shape: NurbsCurve | NurbsSurface):
    """All Bezier pieces as ONE curve or surface with leading axes, each on [0, 1].

    [s] pieces of a curve, [s, r] patches of a surface, one for each span that is not
    empty: evaluate all of them with `jax.vmap(lambda piece: piece(t))(pieces)`.
    """
    if isinstance(shape, NurbsCurve):
        degree = shape.basis.degree
        points = _pieces(shape.basis, shape.homogeneous())
        unit = SplineBasis.clamped(degree + 1, degree)
        return jax.vmap(lambda h: _curve(h, unit, False))(points)
    u, v = shape.bases
    rows = _pieces(u, shape.homogeneous())
    patches = _pieces(v, jnp.moveaxis(rows, 2, 0))
    patches = jnp.moveaxis(patches, (2, 0, 3, 1), (0, 1, 2, 3))
    unit = tuple(SplineBasis.clamped(b.degree + 1, b.degree) for b in (u, v))
    make = lambda h: _surface(h, unit, _WHOLE, (_WHOLE, _WHOLE))
    return jax.vmap(jax.vmap(make))(patches)


def moved(shape: NurbsCurve | NurbsSurface, target_from_source):
    """The curve or surface under a transform, which acts on its control points."""
    control = target_from_source(shape.control)
    if isinstance(shape, NurbsCurve):
        return NurbsCurve(control, shape.basis, shape.weights, closed=shape.closed)
    return NurbsSurface(
        control, shape.bases, shape.weights, closed=shape.closed, poles=shape.poles
    )


def mapped(shape: NurbsCurve | NurbsSurface, plan: SplineMap, *, axis: int = 0):
    """The curve or surface with its homogeneous points under a `SplineMap`."""
    points = jnp.moveaxis(plan(jnp.moveaxis(shape.homogeneous(), axis, 0)), 0, axis)
    if isinstance(shape, NurbsCurve):
        return _curve(points, plan.basis, shape.closed)
    bases = _with(shape.bases, axis, plan.basis)
    return _surface(points, bases, shape.closed, shape.poles)


def _pieces(basis, points):
    matrices = jnp.asarray(bezier_pieces(basis), points.dtype)
    return jnp.tensordot(matrices, points, 1)


def _basis(shape, axis):
    bases = (shape.basis,) if isinstance(shape, NurbsCurve) else shape.bases
    if axis not in range(len(bases)):
        must = "axis must be 0, or 1 for the v of a surface"
        raise GeometryError(message(must, f"{axis}", "Pass one of these."))
    return bases[axis]


def _opened(part, end, axis):
    """A part is not closed along `axis` and keeps the pole at one `end` of it."""
    if isinstance(part, NurbsCurve):
        return NurbsCurve(part.control, part.basis, part.weights)
    pole = part.poles[axis][end]
    poles = _with(part.poles, axis, (pole, False) if end == 0 else (False, pole))
    closed = _with(part.closed, axis, False)
    return NurbsSurface(
        part.control, part.bases, part.weights, closed=closed, poles=poles
    )


def _curve(points, basis, closed):
    return NurbsCurve(*_in_order(points, basis), closed=closed)


def _surface(points, bases, closed, poles):
    return NurbsSurface(*_in_order(points, bases), closed=closed, poles=poles)


def _in_order(points, basis):
    control, weights = from_homogeneous(points)
    return control, basis, weights


def _with(pair, axis, value):
    return tuple(value if i == axis else x for i, x in enumerate(pair))
