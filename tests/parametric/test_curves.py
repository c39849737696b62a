"""Curves: tangent, curvature, torsion, length, frames, and what they refuse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import GeometryError
from jaxgeom import parametric as jp
from jaxgeom.transforms import Rigid, rotation_exp

VERTICES = ((0.1, 0.2, 0.0), (1.3, 0.1, 0.4), (1.1, 0.9, -0.2), (0.2, 0.7, 0.3))


def moved_circle():
    pose = Rigid(rotation_exp(np.array([0.3, 0.8, -0.2])), jnp.array([0.3, 0.1, 0.2]))
    return jp.MovedCurve(jp.Circle(0.7, (0.2, -0.1, 0.4)), pose)


def curves():
    """Name -> curve, curvature, torsion and length where they are known."""
    rise = 0.6 / (2 * np.pi)
    square = 1.1**2 + rise**2
    sides = np.linalg.norm(np.diff(VERTICES, axis=0), axis=1)
    back = np.linalg.norm(np.subtract(VERTICES[0], VERTICES[-1]))
    return {
        "line": (jp.Line((0.1, 0, 0.3), (1.2, 0.5, 0)), 0, 0, np.sqrt(1.55)),
        "circle": (moved_circle(), 1 / 0.7, 0, 1.4 * np.pi),
        "arc": (jp.Arc(0.4, -0.3, 1.1), 2.5, 0, 0.56),
        "helix": (
            jp.Helix(1.1, 0.6, 1.25),
            1.1 / square,
            rise / square,
            2.5 * np.pi * np.sqrt(square),
        ),
        "knot": (jp.TorusKnot(1.2, 0.4), None, None, None),
        "polyline": (jp.Polyline(VERTICES), 0, 0, sides.sum()),
        "closed polyline": (
            jp.Polyline(VERTICES, closed=True),
            *(0, 0, sides.sum() + back),
        ),
        "function": (jp.FunctionCurve(lambda t: jnp.stack([t, t, t])), 0, 0, 3**0.5),
        "nurbs circle": (
            jp.nurbs_circle(0.6, (0.1, 0.2, 0.3)),
            1 / 0.6,
            0,
            1.2 * np.pi,
        ),
    }


@jax.jit
def all_about(curve, t):
    at = lambda t: (curve(t), jp.velocity(curve, t), jp.tangent(curve, t))
    slopes = jax.vmap(lambda t: (curve(t + 1e-5) - curve(t - 1e-5)) / 2e-5)(t)
    bends = jax.vmap(lambda t: jp.bend(curve, t))(t)
    return jax.vmap(at)(t), slopes, bends, jp.length(curve), curve(t[0])


@pytest.mark.parametrize("name", list(curves()))
def test_every_curve(name, x64):
    curve, curvature, torsion, length = curves()[name]
    span = curve.interval()
    t = jnp.asarray(span.low + span.length * np.array([0.03, 0.21, 0.56, 0.94]))
    (points, velocity, tangent), slopes, bends, found, single = all_about(curve, t)
    np.testing.assert_allclose(single, points[0], atol=1e-15)
    np.testing.assert_allclose(velocity, slopes, atol=1e-8)
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    np.testing.assert_allclose(tangent, velocity / speed, atol=1e-14)
    if curvature is not None:
        np.testing.assert_allclose(bends.curvature, curvature, atol=1e-12)
        np.testing.assert_allclose(bends.torsion, torsion, atol=1e-10)
        np.testing.assert_allclose(found, length, rtol=1e-12)
    if span.periodic:
        np.testing.assert_allclose(curve(span.low), curve(span.high), atol=1e-15)


def test_a_polyline_meets_its_vertices_and_follows_them():
    curve = jp.Polyline(VERTICES)
    assert curve.interval().breaks == (1.0, 2.0)
    at = jax.jit(jax.vmap(curve))(jnp.arange(4.0))
    np.testing.assert_allclose(at, VERTICES, atol=1e-7)
    slope = jax.grad(lambda c: c(1.25)[0])(curve).vertices
    np.testing.assert_allclose(slope[:, 0], [0, 0.75, 0.25, 0], atol=1e-6)


FRAMES = jax.jit(
    lambda path, t, n: jax.vmap(lambda s: jp.frame(path, s, stations=n))(t),
    static_argnums=2,
)


@pytest.mark.slow
def test_a_frame_is_orthonormal_and_does_not_turn(x64):
    """On a helix the frame turns against the normal by the torsion: -tau s."""
    helix = jp.Helix(1.1, 0.6, 1.25)
    t = jnp.linspace(0, 2.5 * np.pi, 33)
    path = jax.vmap(lambda s: jp.tangent(helix, s))(t)
    rise = 0.6 / (2 * np.pi)
    inward = -jnp.stack([jnp.cos(t), jnp.sin(t), 0 * t], axis=1)
    errors = []
    for stations in (8, 16, 32):
        frames = FRAMES(helix, t, stations)
        full = jnp.concatenate([path[:, None], frames], axis=1)
        gram = jnp.einsum("nid,njd->nij", full, full) - jnp.eye(3)
        np.testing.assert_allclose(gram, 0, atol=1e-12)
        np.testing.assert_allclose(jnp.linalg.det(full), 1, rtol=1e-12)
        x, y = (jnp.einsum("nd,nd->n", inward, frames[:, i]) for i in range(2))
        angle = jnp.unwrap(jnp.arctan2(y, x))
        turned = rise / np.hypot(1.1, rise) * t
        errors.append(float(jnp.max(jnp.abs(angle - angle[0] - turned))))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (orders > 3.7).all(), (errors, orders)


def test_a_frame_has_derivatives_at_its_stations_and_closes(x64):
    knot = jp.TorusKnot(1.2, 0.4)
    frames = FRAMES(knot, jnp.array([0.0, 2 * np.pi]), 32)
    np.testing.assert_allclose(frames[0], frames[1], atol=1e-12)
    station, h = 2 * np.pi * 5 / 32, 1e-5
    at = lambda s: jp.frame(knot, s, stations=32)
    both = lambda s: (jax.jacfwd(at)(s), at(s), at(s + h), at(s - 1e-9))
    slope, here, ahead, before = jax.jit(both)(jnp.asarray(station))
    np.testing.assert_allclose(here, before, atol=1e-8)
    np.testing.assert_allclose(slope, (ahead - here) / h, atol=1e-4)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: jp.Interval(1.0, 0.5), "increase"),
        (lambda: jp.Interval(0, 1, breaks=(0.5, 0.5)), "increase"),
        (lambda: jp.Interval(0, 1, periodic=True, poles=(True, False)), "no ends"),
        (lambda: jp.Interval(0, 1, twisted=True), "periodic"),
        (lambda: jp.Polyline(((0.0, 0, 0),)), "2 vertices"),
        (lambda: jp.Polyline(((0.0, 0, 0), (1.0, 0, 0)), closed=True), "3 vertices"),
        (lambda: jp.Line((0.0, 0.0), (1.0, 0.0, 0.0)), "shape"),
        (lambda: jp.nurbs_arc(1.0, 0.5, 0.2), "end of an arc"),
        (lambda: jp.Swept(moved_circle(), moved_circle(), stations=1), "stations"),
        (lambda: jp.Sphere(0.7)(jnp.zeros(3)), "uv must have shape"),
    ],
)
def test_bad_input_is_refused(make, words):
    with pytest.raises(GeometryError, match=words):
        make()
