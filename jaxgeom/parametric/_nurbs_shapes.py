"""Circles, spheres, tori and all surfaces of revolution, exactly, as NURBS."""

import jax.numpy as jnp
import numpy as np

from .._core import GeometryError, message
from ._abstract import floating
from ._curves import TURN
from ._nurbs import NurbsCurve, NurbsSurface
from ._splines import SplineBasis

_ORIGIN = (0.0, 0.0, 0.0)


def nurbs_arc(
    radius, start: float = 0.0, end: float = TURN, *, center=_ORIGIN
) -> NurbsCurve:
    """The arc of a circle in the plane of x and y, exactly, on 0 <= t <= 1.

    From the angle `start` to `end` > start, static, in rational quadratic pieces of at
    most a quarter turn; |c - center| = `radius` to rounding. t is not the angle. A
    whole turn is closed.

    Raises `GeometryError` unless 0 < end - start <= 2 pi. Source: Piegl, Tiller, The
    NURBS book, 1997, section 7.5.
    """
    if not 0 < end - start <= TURN * (1 + 1e-15):
        must = "the end of an arc lies after its start, at most a turn"
        raise GeometryError(message(must, f"{start} to {end}", "Change the angles."))
    plane, weights, basis = _unit_arc(start, end)
    radius, center = floating(radius), floating(center)
    flat = jnp.asarray(np.pad(plane, ((0, 0), (0, 1))), radius.dtype)
    whole = end - start >= TURN * (1 - 1e-15)
    given = jnp.asarray(weights, radius.dtype)
    return NurbsCurve(center + radius * flat, basis, given, closed=bool(whole))


def nurbs_circle(radius, center=_ORIGIN) -> NurbsCurve:
    """The circle of `radius` about `center` in the plane of x and y: nine points."""
    return nurbs_arc(radius, center=center)


def nurbs_revolution(
    profile: NurbsCurve, *, poles: tuple[bool, bool] = (False, False)
) -> NurbsSurface:
    """A NURBS curve turned about the z axis, exactly: u around, v along the curve.

    With a curve in the half plane y = 0, x > 0 that rises, the normal points outwards.
    `poles`: whether the curve (begins, ends) on the axis; static.
    """
    plane, weights, basis = _unit_arc(0.0, TURN)
    a, b = jnp.asarray(plane.T[:, :, None], profile.control.dtype)
    x, y, z = profile.control.T
    net = jnp.stack([a * x - b * y, a * y + b * x, 0 * a + z], axis=-1)
    around = jnp.asarray(weights, profile.weights.dtype)
    return NurbsSurface(
        net,
        (basis, profile.basis),
        around[:, None] * profile.weights,
        closed=(True, profile.closed),
        poles=((False, False), tuple(poles)),
    )


def nurbs_sphere(radius, center=_ORIGIN) -> NurbsSurface:
    """The sphere of `radius` about `center`, exactly: 9 x 5 points, poles along z."""
    arc = nurbs_arc(radius, -np.pi / 2, np.pi / 2)
    return _shifted(nurbs_revolution(_upright(arc), poles=(True, True)), center)


def nurbs_torus(major, minor, center=_ORIGIN) -> NurbsSurface:
    """The torus about z with radii `major` and `minor`, exactly: 9 x 9 points."""
    major = floating(major)
    zero = jnp.zeros_like(major)
    circle = nurbs_arc(minor, center=jnp.stack([major, zero, zero]))
    return _shifted(nurbs_revolution(_upright(circle)), center)


def _unit_arc(start, end):
    """Points [n, 2], weights [n] and basis of an arc of the unit circle (host)."""
    pieces = max(1, int(np.ceil((end - start) / (TURN / 4) - 1e-9)))
    half = (end - start) / pieces / 2
    angles = start + half * np.arange(2 * pieces + 1)
    weights = np.where(np.arange(2 * pieces + 1) % 2, np.cos(half), 1.0)
    points = np.stack([np.cos(angles), np.sin(angles)], axis=1) / weights[:, None]
    inner = np.repeat(np.arange(1, pieces) / pieces, 2)
    return points, weights, SplineBasis([0, 0, 0, *inner, 1, 1, 1], 2)


def _upright(curve):
    """A curve of the plane of x and y turned into that of x and z."""
    x, y, z = curve.control.T
    control = jnp.stack([x, z, y], axis=-1)
    return NurbsCurve(control, curve.basis, curve.weights, closed=curve.closed)


def _shifted(surface, center):
    return NurbsSurface(
        surface.control + floating(center),
        surface.bases,
        surface.weights,
        closed=surface.closed,
        poles=surface.poles,
    )
