"""NURBS against scipy's B-splines, and every exact map of their control points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import BSpline, NdBSpline

from jaxgeom import GeometryError
from jaxgeom import parametric as jp
from jaxgeom.transforms import Affine

from .members import in_dtype, net

BASES = {
    "cubic, repeated": jp.SplineBasis([0, 0, 0, 0, 0.3, 0.5, 0.5, 0.9, 1, 1, 1, 1], 3),
    "quadratic, open ends": jp.SplineBasis(
        [-0.4, -0.2, 0, 0.3, 0.5, 0.5, 0.9, 1, 1.2, 1.3], 2
    ),
    "quintic": jp.SplineBasis([2] * 6 + [2.4, 2.4, 2.4, 3.4] + [4] * 6, 5),
    "linear": jp.SplineBasis([0, 0, 0.4, 1, 1], 1),
    "no spans inside": jp.SplineBasis.clamped(4, 3),
    "closed": jp.SplineBasis.closed(6, 3),
}


def points(basis, seed=0):
    return np.random.default_rng(seed).normal(size=(basis.num_control, 3))


def places(basis, number=23):
    """Parameters with all knots, none twice."""
    t = np.linspace(basis.low, basis.high, number)
    return np.unique([*t, *basis.breaks])


@pytest.mark.parametrize("name", list(BASES))
def test_bases_are_those_of_scipy(name, x64):
    basis = BASES[name]
    t, control = places(basis), points(basis)
    at = jax.jit(jax.vmap(lambda t: basis.derivatives(t, 2)))
    rows = np.asarray(at(jnp.asarray(t)))
    assert (rows[:, 0] >= 0).all()
    np.testing.assert_allclose(rows[:, 0].sum(axis=1), 1, atol=1e-14)
    np.testing.assert_allclose(rows[:, 1:].sum(axis=2), 0, atol=1e-9)
    spline = BSpline(np.array(basis.knots), control, basis.degree)
    # scipy takes the last knot from the right, where its spline ends.
    inner = t[:-1]
    for order in range(3):
        expected = (
            spline(inner, order)
            if order <= basis.degree
            else 0 * rows[:-1, 0] @ control
        )
        scale = np.max(np.abs(expected), initial=1)
        np.testing.assert_allclose(
            rows[:-1, order] @ control, expected, atol=1e-12 * scale
        )


def test_tensor_products_are_those_of_scipy(x64):
    surface = in_dtype(net(), jnp.float64)
    homogeneous = np.asarray(surface.homogeneous())
    uv = np.random.default_rng(3).uniform((0, -0.5), (1, 1.2), (40, 2))
    knots = tuple(np.array(b.knots) for b in surface.bases)
    spline = NdBSpline(knots, homogeneous, (3, 2))
    lifted = spline(uv)
    at = jax.jit(jax.vmap(lambda x: (surface(x), surface.derivatives(x, 2))))
    point, table = at(jnp.asarray(uv))
    np.testing.assert_allclose(point, lifted[:, :3] / lifted[:, 3:], atol=1e-14)
    np.testing.assert_allclose(table[:, 0, 0], point, atol=1e-14)
    slope = spline(uv, nu=(1, 0))
    quotient = (slope[:, :3] - slope[:, 3:] * np.asarray(point)) / lifted[:, 3:]
    np.testing.assert_allclose(table[:, 1, 0], quotient, atol=1e-12)


def test_derivatives_by_quotients_are_those_of_autodiff(x64):
    surface = in_dtype(net(), jnp.float64)
    curve = jp.NurbsCurve(
        surface.control[:, 2], surface.bases[0], surface.weights[:, 1]
    )
    # At a double knot of v and a single one of u, inside, and at the last ones.
    uv = jnp.array([[0.35, 0.1], [0.42, 0.77], [1.0, 1.2], [0.0, -0.5]])

    @jax.jit
    @jax.vmap
    def both(x):
        first = jax.jacfwd(surface)
        return (
            surface.derivatives(x, 2),
            (surface(x), first(x), jax.jacfwd(first)(x)),
            curve.derivatives(x[0], 2),
            (curve(x[0]), jax.jacfwd(curve)(x[0]), jax.jacrev(jax.jacfwd(curve))(x[0])),
        )

    table, (x, first, second), row, by_autodiff = both(uv)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(both(uv)))
    np.testing.assert_allclose(table[:, 0, 0], x, atol=1e-14)
    np.testing.assert_allclose(table[:, 1, 0], first[..., 0], atol=1e-12)
    np.testing.assert_allclose(table[:, 0, 1], first[..., 1], atol=1e-12)
    np.testing.assert_allclose(table[:, 1, 1], second[..., 0, 1], atol=1e-11)
    np.testing.assert_allclose(table[:, 2, 0], second[..., 0, 0], atol=1e-10)
    np.testing.assert_allclose(table[:, 0, 2], second[..., 1, 1], atol=1e-10)
    for order, expected in enumerate(by_autodiff):
        np.testing.assert_allclose(row[:, order], expected, atol=1e-10)


def test_large_nets_are_gathered_from(x64):
    """Beyond a number of points another contraction is used: same values and slopes."""
    generator = np.random.default_rng(5)
    control = jnp.asarray(generator.normal(size=(36, 32, 3)))
    weights = jnp.asarray(generator.uniform(0.5, 2, (36, 32)))
    bases = (jp.SplineBasis.clamped(36, 3), jp.SplineBasis.clamped(32, 2))
    surface = jp.NurbsSurface(control, bases, weights)
    uv = jnp.asarray(generator.uniform(size=(5, 2)))
    at = jax.vmap(lambda x: (surface(x), surface.derivatives(x, 1)[0, 0]))
    gathered, dense = jax.jit(at)(uv)
    np.testing.assert_allclose(gathered, dense, atol=1e-13)


def changed(basis):
    low, length = basis.low, basis.high - basis.low
    added = low + length * np.array([0.13, 0.77, 0.77][: basis.degree + 1])
    added = added[:2] if basis.degree == 1 else added
    return {
        "insertion": jp.insertion(basis, added),
        "elevation": jp.elevation(basis, 2),
        "both": jp.insertion(basis, added[:1]).then(
            jp.elevation(jp.insertion(basis, added[:1]).basis)
        ),
    }


@pytest.mark.parametrize("name", list(BASES))
def test_maps_between_bases_leave_the_curve(name):
    """All on the host: the new control points over the new knots, by scipy."""
    basis = BASES[name]
    control, t = points(basis), places(basis)[:-1]
    before = BSpline(np.array(basis.knots), control, basis.degree)(t)
    for kind, plan in changed(basis).items():
        assert plan.matrix.shape == (plan.basis.num_control, basis.num_control), kind
        after = BSpline(
            np.array(plan.basis.knots), plan.matrix @ control, plan.basis.degree
        )
        np.testing.assert_allclose(after(t), before, atol=2e-13, err_msg=kind)
        np.testing.assert_allclose(plan.matrix.sum(axis=1), 1, atol=1e-12)
    assert (changed(basis)["insertion"].matrix >= -1e-15).all()


@jax.jit
def all_operations(surface, uv):
    """The surface at uv and, over every change of its net, at the same places."""
    left, right = jp.split(surface, 0.5)
    front, back = jp.split(surface, 0.1, axis=1)
    pieces = jp.bezier(surface)
    same = {
        "inserted": jp.insert_knots(surface, (0.2, 0.6), axis=0),
        "inserted in v": jp.insert_knots(surface, (0.7,), axis=1),
        "elevated": jp.elevate_degree(surface, 2, axis=0),
        "elevated in v": jp.elevate_degree(surface, axis=1),
    }
    at = lambda s: jax.vmap(s)(uv)
    inside = lambda a, b: jnp.clip(uv, jnp.array([a, -9.0]), jnp.array([b, 9.0]))
    turned = uv.at[:, 0].set(1 - uv[:, 0])
    halves = [(left, inside(0.0, 0.5)), (right, inside(0.5, 1.0))]
    parts = [(front, uv.at[:, 1].set(-0.2)), (back, uv.at[:, 1].set(0.4))]
    return {
        "base": at(surface),
        "same": jax.tree.map(
            at, same, is_leaf=lambda x: isinstance(x, jp.NurbsSurface)
        ),
        "reversed": jax.vmap(jp.reverse(surface))(turned),
        "parts": [(jax.vmap(s)(x), jax.vmap(surface)(x)) for s, x in halves + parts],
        "bezier": jax.vmap(jax.vmap(lambda s: s(jnp.array([0.25, 0.5]))))(pieces),
        "middles": surface(jnp.array([0.35 + 0.25 * 0.25, (0.1 + 1.2) / 2])),
    }


def test_operations_on_a_surface_leave_it(x64):
    surface = in_dtype(net(), jnp.float64)
    uv = jnp.asarray(np.random.default_rng(1).uniform((0, -0.5), (1, 1.2), (9, 2)))
    found = all_operations(surface, uv)
    for name, value in found["same"].items():
        np.testing.assert_allclose(value, found["base"], atol=1e-13, err_msg=name)
    np.testing.assert_allclose(found["reversed"], found["base"], atol=1e-13)
    for part, whole in found["parts"]:
        np.testing.assert_allclose(part, whole, atol=1e-13)
    # The second of three pieces along u, the second of two along v.
    assert found["bezier"].shape == (3, 2, 3)
    np.testing.assert_allclose(found["bezier"][1, 1], found["middles"], atol=1e-13)


def test_derivatives_pass_through_insertion(x64):
    """A matrix acts on points and weights: gradients are those of the curve itself."""
    curve = jp.NurbsCurve(
        points(jp.SplineBasis.clamped(5, 2)),
        jp.SplineBasis.clamped(5, 2),
        np.array([1.0, 0.7, 1.6, 0.9, 1.2]),
    )
    reach = lambda c: jnp.sum(c(0.4) ** 2)
    direct, through = jax.jit(
        lambda c: (
            jax.grad(reach)(c),
            jax.grad(lambda c: reach(jp.insert_knots(c, (0.3, 0.4))))(c),
        )
    )(curve)
    np.testing.assert_allclose(direct.control, through.control, atol=1e-14)
    np.testing.assert_allclose(direct.weights, through.weights, atol=1e-14)
    many = jax.vmap(
        lambda w: (
            jp.insert_knots(jp.NurbsCurve(curve.control, curve.basis, w), 0.3).control
        )
    )(jnp.stack([curve.weights] * 2))
    np.testing.assert_allclose(many[1], jp.insert_knots(curve, 0.3).control, atol=1e-14)


def test_circles_spheres_and_tori_are_exact(x64):
    center = np.array([0.1, -0.2, 0.3])
    circle, arc = (
        jp.nurbs_circle(0.7, center),
        jp.nurbs_arc(0.7, 0.3, 3.9, center=center),
    )
    sphere, torus = jp.nurbs_sphere(0.7, center), jp.nurbs_torus(1.3, 0.4, center)
    uv = jnp.asarray(np.random.default_rng(2).uniform(size=(200, 2)))

    @jax.jit
    def gaps(shapes):
        circle, arc, sphere, torus = shapes
        at = lambda s, x: jax.vmap(s)(x) - center
        x, y, z = at(torus, uv).T
        return (
            jnp.linalg.norm(at(circle, uv[:, 0]), axis=1) - 0.7,
            jnp.linalg.norm(at(arc, uv[:, 0]), axis=1) - 0.7,
            jnp.linalg.norm(at(sphere, uv), axis=1) - 0.7,
            jnp.hypot(jnp.hypot(x, y) - 1.3, z) - 0.4,
            arc(0.0) - center - 0.7 * jnp.array([jnp.cos(0.3), jnp.sin(0.3), 0]),
            arc(1.0) - center - 0.7 * jnp.array([jnp.cos(3.9), jnp.sin(3.9), 0]),
        )

    for gap in gaps((circle, arc, sphere, torus)):
        np.testing.assert_allclose(gap, 0, atol=1e-14)
    slope = jax.grad(lambda r: jp.nurbs_circle(r)(0.3)[0])(jnp.asarray(0.7))
    np.testing.assert_allclose(slope, jp.nurbs_circle(1.0)(0.3)[0], atol=1e-14)


def test_affine_maps_act_on_control_points(x64):
    matrix, shift = np.random.default_rng(4).normal(size=(2, 3, 3))
    affine = Affine(jnp.asarray(matrix), jnp.asarray(shift[0]))
    surface, uv = in_dtype(net(), jnp.float64), jnp.array([0.3, 0.6])
    moved = jp.moved(surface, affine)(uv)
    np.testing.assert_allclose(moved, affine(surface(uv)), atol=1e-13)
    np.testing.assert_allclose(moved, jp.MovedSurface(surface, affine)(uv), atol=1e-13)


def test_a_closed_curve_is_smooth_where_it_closes(x64):
    corners = np.random.default_rng(6).normal(size=(6, 3))
    curve = jp.NurbsCurve.through_wrapped(corners)
    ends = jax.jit(jax.vmap(lambda t: curve.derivatives(t, 2)))(jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-11)
    assert curve.interval().periodic


CUBIC = jp.SplineBasis.clamped(6, 3)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: jp.SplineBasis([0, 0, 1, 0.5, 1, 1], 2), "must not decrease"),
        (lambda: jp.SplineBasis([0, 0, 0, 1, 1], 2), "at least 6 knots"),
        (lambda: jp.SplineBasis([0, 0, 0, np.nan, 1, 1, 1], 2), "finite"),
        (lambda: jp.SplineBasis([0, 0, 0.5, 0.5, 1, 1], 1), "repeated"),
        (lambda: jp.SplineBasis([0] * 6, 2), "repeated"),
        (lambda: jp.SplineBasis([0, 1], 0), "degree must be at least 1"),
        (lambda: jp.SplineBasis.clamped(4, 4), "at least 5 control points"),
        (lambda: jp.SplineBasis.closed(3, 4), "at least 4 control points"),
        (lambda: jp.NurbsCurve(np.zeros((5, 3)), CUBIC), "must have 6 points"),
        (lambda: jp.NurbsCurve(np.zeros(6), CUBIC), "shape"),
        (lambda: jp.NurbsCurve(np.zeros((6, 3)), CUBIC, np.ones(5)), "weights"),
        (
            lambda: jp.NurbsCurve(
                np.zeros((6, 3)), CUBIC, np.array([1, 1, 0, 1, 1, 1.0])
            ),
            "weights must be positive",
        ),
        (
            lambda: jp.NurbsSurface(np.zeros((6, 5, 3)), (CUBIC, CUBIC)),
            "axis 1 of control must have 6",
        ),
        (lambda: jp.insertion(CUBIC, 1.5), "must lie in"),
        (lambda: jp.insertion(CUBIC, [0.5] * 4), "repeated"),
        (lambda: jp.elevation(CUBIC, -1), "elevated"),
        (lambda: jp.split(jp.nurbs_circle(1.0), 1.0), "strictly inside"),
        (lambda: jp.reverse(jp.nurbs_circle(1.0), axis=1), "axis"),
    ],
)
def test_bad_input_is_refused(make, words):
    with pytest.raises(GeometryError, match=words):
        make()
