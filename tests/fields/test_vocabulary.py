"""What fields mean: bodies written in two ways, fillets, outlines, polynomials."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from jaxgeom import fields as jf
from jaxgeom.shapes import Grid, TriangleMesh

POINTS = np.random.default_rng(3).uniform(-1.2, 1.2, (300, 3))
FILLETS = [
    jf.CubicFillet(),
    jf.QuadraticFillet(),
    jf.QuarticFillet(),
    jf.CircularFillet(),
    jf.ExponentialFillet(),
    jf.RootFillet(),
    jf.SigmoidFillet(),
]


def pairs():
    """The same body, from two formulas that have nothing in common."""
    ball = jf.Sphere(0.2, (0.05, 0.02, 0.0))
    move = lambda *shift: ball.translate(shift)
    around = lambda i: jf.Sphere(0.2, (0.6 * np.cos(i), 0.6 * np.sin(i), 0.1))
    octahedron = jf.Octahedron(0.7)
    mesh = TriangleMesh(octahedron.corners(), jnp.asarray(octahedron.faces()))
    tall = jf.Capsule((0, 0, -0.3), (0, 0, 0.3), 0.2)
    tips = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.6)]
    return {
        "torus": (jf.Circle(0.2).revolve(0.6), jf.Torus(0.6, 0.2)),
        "wide torus": (jf.CappedTorus(0.6, 0.2, np.pi), jf.Torus(0.6, 0.2)),
        "box": (jf.Rectangle((0.4, 0.3)).extrude(0.5), jf.Box((0.4, 0.3, 0.5))),
        "cylinder": (jf.CappedCone(0.4, 0.4, 0.3), jf.Cylinder(0.4, 0.3)),
        "disk": (jf.Circle(0.4).extrude(0.3), jf.Cylinder(0.4, 0.3)),
        "ball": (jf.ExactEllipsoid((0.5, 0.5, 0.5)), jf.Sphere(0.5)),
        "round cone": (jf.RoundCone(0.4, 0.2, 0.6), jf.RoundTube(*tips, 0.4, 0.2)),
        "capsule": (jf.RoundTube(*tips, 0.2, 0.2), jf.Capsule(*tips, 0.2)),
        "pull": (jf.Sphere(0.2).elongate((0, 0, 0.3)), tall),
        "link": (jf.Link(0.0, 0.5, 0.2).rotate(_QUARTER), jf.Torus(0.5, 0.2)),
        "prism": (
            jf.Prism(0.5 * 2**0.5, 0.3, 4).rotate(_EIGHTH),
            jf.Box((0.5, 0.5, 0.3)),
        ),
        "row": (
            ball.repeat((0.7, 1.0, 1.0), (3, 1, 1)),
            move(-0.7, 0, 0) | ball | move(0.7, 0, 0),
        ),
        "two": (
            ball.repeat((0.7, 1.0, 1.0), (2, 1, 1)),
            move(-0.35, 0, 0) | move(0.35, 0, 0),
        ),
        "mirror": (
            ball.translate((0.4, 0, 0)).mirror((2.0, 0, 0), 0.1),
            move(0.4, 0, 0) | jf.Sphere(0.2, (-0.25, 0.02, 0.0)),
        ),
        "around": (
            around(0.0).repeat_around(3),
            around(0.0) | around(2 * np.pi / 3) | around(4 * np.pi / 3),
        ),
        "mesh": (jf.MeshDistance(mesh), octahedron),
        "loft": (
            jf.Lofted(jf.Circle(0.4), jf.Circle(0.4), 0.3),
            jf.Cylinder(0.4, 0.3),
        ),
        "half disks": (
            jf.CutSphere(0.5, 0.2) | (~jf.CutSphere(0.5, 0.2) & jf.Sphere(0.5)),
            jf.Sphere(0.5),
        ),
        "cyclide": (
            jf.dupin_cyclide(1.0, 1.0, 0.4),
            jf.algebraic_torus(1.0, 0.4),
        ),
    }


_QUARTER = jnp.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
_EIGHTH = jnp.array([[1.0, -1, 0], [1, 1, 0], [0, 0, 2**0.5]]) / 2**0.5


def test_two_ways_to_write_a_body_agree(x64):
    table = pairs()
    run = jax.jit(lambda t, p: jax.tree.map(lambda f: jax.vmap(f)(p), t, is_leaf=_leaf))
    for name, (a, b) in run(table, jnp.asarray(POINTS)).items():
        # A cut ball and its rest share a face, inside of which the union is a bound; a
        # loft is a bound outside.
        kept = {"half disks": b > 0, "loft": b < 0}.get(name, np.full(b.shape, True))
        np.testing.assert_allclose(a[kept], b[kept], atol=1e-7, err_msg=name)


def _leaf(x):
    return isinstance(x, jf.AbstractField)


def test_fillets_keep_their_theorem(x64):
    k = 0.07
    a, b = jnp.asarray(np.random.default_rng(0).normal(size=(2, 2000)))
    b = b.at[:10].set(a[:10])
    for fillet in FILLETS:
        both = lambda p, f=fillet: jf.SmoothUnion(
            lambda x: x[0], lambda x: x[1], 6 * k, f
        )(p)
        value, slope = jax.jit(jax.vmap(jax.value_and_grad(both)))(jnp.stack([a, b], 1))
        drop = jnp.minimum(a, b) - value
        assert drop.min() >= 0 and drop.max() <= k * (1 + 1e-12), fillet
        np.testing.assert_allclose(drop[:10], k, rtol=1e-12)
        np.testing.assert_allclose(slope.sum(axis=1), 1, rtol=1e-12)
        assert slope.min() >= 0 and slope.max() <= 1 + 1e-12, fillet
        np.testing.assert_allclose(slope[:10], 0.5, rtol=1e-12)


def test_the_union_of_many_has_no_order(x64):
    radii = jnp.array([0.3, 0.25, 0.2, 0.35])
    places = jnp.asarray(np.random.default_rng(1).uniform(-0.5, 0.5, (4, 3)))
    balls = [jf.Sphere(r, p) for r, p in zip(radii, places, strict=True)]
    k = 0.05
    forward = jf.UnionOfMany(tuple(balls), 6 * k)
    stacked = jf.UnionOfMany(jf.stack_fields(balls[::-1]), 6 * k)
    values = lambda f: np.asarray(jf.value(f, jnp.asarray(POINTS)))
    np.testing.assert_allclose(values(forward), values(stacked), atol=1e-12)
    drop = values(jf.UnionOfMany(tuple(balls))) - values(forward)
    assert drop.min() > 0 and drop.max() <= 2 * k
    pair = jf.UnionOfMany(tuple(balls[:2]), 6 * k)
    other = jf.SmoothUnion(*balls[:2], 6 * k, jf.ExponentialFillet())
    np.testing.assert_allclose(values(pair), values(other), atol=1e-12)


def border(outline, count=400):
    """Points of an outline, by walking along its lines and arcs (numpy)."""
    corners = np.asarray(outline.corners)
    bulges = outline.bulges
    bulges = np.zeros(len(corners)) if bulges is None else np.asarray(bulges)
    t = np.linspace(0, 1, count, endpoint=False)[:, None]
    walked = []
    for i, (a, b) in enumerate(zip(corners, np.roll(corners, -1, axis=0), strict=True)):
        if abs(bulges[i]) < 1e-12:
            walked.append(a + t * (b - a))
            continue
        sweep = 4 * np.arctan(bulges[i])
        # b - c = R (a - c) with R the turn by the sweep.
        turn = lambda x: np.array([[np.cos(x), -np.sin(x)], [np.sin(x), np.cos(x)]])
        center = np.linalg.solve(np.eye(2) - turn(sweep), b - turn(sweep) @ a)
        walked.append(
            np.stack([center + turn(sweep * s) @ (a - center) for s in t[:, 0]])
        )
    return np.concatenate(walked)


def winding(points, loop):
    """How often a closed chain runs around points."""
    spokes = loop[None] - points[:, None]
    angle = np.unwrap(np.arctan2(spokes[..., 1], spokes[..., 0]), axis=1)
    closing = angle[:, -1:] + np.angle(np.exp(1j * (angle[:, :1] - angle[:, -1:])))
    return np.round((closing[:, 0] - angle[:, 0]) / (2 * np.pi))


def test_outlines_agree_with_a_walk_along_them(x64):
    outlined = {
        "pie": jf.Pie(0.6, 2.2),
        "cut_disk": jf.CutDisk(0.6, -0.25),
        "horseshoe": jf.Horseshoe(0.5, 0.2, 0.6),
        "vesica": jf.Vesica(0.8, 0.45),
        "moon": jf.Moon(0.6, 0.4, 0.5),
        "uneven_capsule": jf.UnevenCapsule(0.4, 0.15, 0.6),
        "egg": jf.Egg(0.5, 0.2),
        "heart": jf.Heart(0.8),
        "star": jf.Star(0.7, 0.3),
        "cross": jf.Cross(0.6, 0.17),
        "gear": jf.Gear(0.5, 0.65, 9),
        "chamfered_rectangle": jf.ChamferedRectangle((0.5, 0.3), 0.1),
        "stairs": jf.Stairs((0.3, 0.2), 3),
    }
    points = POINTS[:, :2]
    values = jax.jit(lambda t, p: {k: jax.vmap(f)(p) for k, f in t.items()})(
        outlined, jnp.asarray(points)
    )
    for name, shape in outlined.items():
        loop = border(shape.outline())
        gaps = np.linalg.norm(points[:, None] - loop[None], axis=-1).min(axis=1)
        inside = winding(points, loop) == 1
        mine = np.asarray(values[name])
        step = np.linalg.norm(np.diff(loop, axis=0), axis=1).max()
        np.testing.assert_array_equal(mine < 0, inside, err_msg=name)
        assert (gaps >= np.abs(mine) - 1e-9).all(), name
        assert (gaps - np.abs(mine)).max() < step, name


def test_a_parabola_agrees_with_points_along_it(x64):
    """Also on its axis, where two places are nearest, and far from its tip."""
    points = np.concatenate([POINTS[:, :2], [[0, 1.0], [0, 0.1], [0, -2], [30, -5]]])
    s = np.linspace(-3, 3, 600_001)
    curve = np.stack([s, 1.3 * s**2], axis=1)
    values = jax.jit(jax.vmap(jf.Parabola(1.3)))(jnp.asarray(points))
    nearest = cKDTree(curve).query(points)[0]
    sign = np.where(points[:, 1] > 1.3 * points[:, 0] ** 2, -1, 1)
    np.testing.assert_allclose(values, sign * nearest, atol=1e-7)


def test_a_rounded_cross_agrees_with_points_along_it(x64):
    turn = np.linspace(0, 1, 4001)[:, None]
    radius = (0.7**2 + 0.5**2) / (2 * 0.5)
    angle = turn * np.arccos((radius - 0.5) / radius)
    arc = np.concatenate(
        [0.7 - radius * np.sin(angle), radius - radius * np.cos(angle)], 1
    )
    sides = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    border = np.concatenate([arc * side for side in sides])
    points = np.concatenate([POINTS[:, :2], [[0.7, -0.3], [0.9, 0.0], [0.0, 0.0]]])
    values = jax.jit(jax.vmap(jf.RoundedCross((0.7, 0.5))))(jnp.asarray(points))
    np.testing.assert_allclose(
        np.abs(values), cKDTree(border).query(points)[0], atol=2e-4
    )
    p = np.abs(points)
    inside = (p[:, 0] < 0.7) & (p[:, 1] < 0.5)
    inside &= np.hypot(p[:, 0] - 0.7, p[:, 1] - radius) > radius
    np.testing.assert_array_equal(values < 0, inside)


def test_solids_agree_with_the_hull_of_their_corners(x64):
    solids = {
        "octahedron": jf.Octahedron(0.7),
        "tetrahedron": jf.Tetrahedron(0.8),
        "icosahedron": jf.Icosahedron(0.7),
        "dodecahedron": jf.Dodecahedron(0.6),
        "pyramid": jf.Pyramid(0.4, 0.7),
    }
    for name, solid in solids.items():
        hull = ConvexHull(np.asarray(solid.corners()))
        planes = hull.equations
        lowest = (POINTS @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        mine = np.asarray(jax.jit(jax.vmap(solid))(jnp.asarray(POINTS)))
        inside = lowest < 0
        assert inside.sum() > 1, name
        np.testing.assert_allclose(mine[inside], lowest[inside], atol=1e-9)
        assert (mine[~inside] >= lowest[~inside] - 1e-9).all(), name


def test_a_polynomial_is_its_formula(x64):
    formula = lambda x, y, z: 2 - (x - y / 2) ** 3 * z + 3 * x * y - (-z) ** 2
    mine = jf.value(jf.Polynomial.of(formula), jnp.asarray(POINTS))
    np.testing.assert_allclose(mine, formula(*POINTS.T), atol=1e-12)
    along = jf.value(jf.Polynomial.of(formula).derivative(0), jnp.asarray(POINTS))
    x, y, z = POINTS.T
    np.testing.assert_allclose(along, -3 * (x - y / 2) ** 2 * z + 3 * y, atol=1e-12)


def test_nodes_are_where_the_books_have_them(x64):
    nodes = {
        "cayley": (jf.cayley_cubic(), (1, 1, -1)),
        "barth": (jf.barth_sextic(), (1, 0, 0)),
        "kummer": (jf.kummer_quartic(1.3), (0, (1.3**2 - 1) ** 0.5, 1)),
        "chmutov": (jf.chmutov(4), (2**-0.5, 2**-0.5, 0)),
        "ding-dong": (jf.ding_dong(), (0, 0, 0)),
        "roman": (jf.steiner_roman(), (0, 0, 0.3)),
    }
    for name, (field, node) in nodes.items():
        value, slope = jax.value_and_grad(field)(jnp.asarray(node, float))
        assert abs(value) < 1e-12 and np.abs(slope).max() < 1e-12, name


@pytest.mark.slow
def test_the_bound_of_the_curvature_holds_and_is_not_wasteful(x64):
    field, ends = jf.barth_sextic(), jnp.full(3, 1.3)
    bound = field.curvature(-ends, ends)
    points = jax.random.uniform(jax.random.key(0), (4000, 3), float, -1.3, 1.3)
    hessians = jax.jit(jax.vmap(jax.hessian(field)))(points)
    largest = np.linalg.norm(hessians, ord=2, axis=(1, 2)).max()
    assert largest <= bound <= 4 * largest
    tight = field.within(-ends, ends)
    near = jax.jit(jax.vmap(lambda p: jf.project(field, p).point))(points[:300] / 2)
    value, slope = jax.jit(jax.vmap(jax.value_and_grad(tight)))(near)
    there = (np.abs(near).max(axis=1) < 1.2) & (np.abs(value) < 1e-9)
    steep = np.linalg.norm(jax.vmap(jax.grad(field))(near), axis=1) > 0.5
    assert (there & steep).sum() > 50
    np.testing.assert_allclose(
        np.linalg.norm(slope, axis=1)[there & steep], 1, atol=1e-5
    )


def test_words_grow_and_the_turtle_comes_home():
    algae = jf.LSystem("A", (("A", "AB"), ("B", "A")))
    assert [len(algae.word(n)) for n in range(7)] == [1, 2, 3, 5, 8, 13, 21]
    koch = jf.LSystem("F--F--F", (("F", "F+F--F+F"),), angle=60.0)
    flake = koch.branches(2)
    assert flake.starts.shape == (48, 3)
    np.testing.assert_allclose(flake.ends[-1], 0, atol=1e-5)
    with pytest.raises(ValueError, match="at least one branch"):
        algae.branches(2)


def test_tricubic_samples_converge_one_order_faster(x64):
    f = lambda p: jnp.sin(2 * p[0]) * jnp.cos(p[1]) + jnp.sin(1.5 * p[2])
    points = jax.random.uniform(jax.random.key(0), (200, 3), float, -0.5, 0.5)

    def error(kind, n):
        spacing = jnp.array([2.0, 2.2, 2.4]) / n
        grid = Grid(jnp.array([-1.0, -1.1, -1.2]), spacing, (n + 1,) * 3)
        return np.abs(
            jf.value(kind(grid, jf.sample(f, grid)), points) - f(points.T)
        ).max()

    for kind, order in ((jf.Sampled, 2), (jf.CubicSampled, 3)):
        assert np.log2(error(kind, 12) / error(kind, 24)) > order - 0.3


def test_a_plain_function_has_documented_claims():
    seen = jf.claims(lambda p: p[0])
    assert np.isnan(seen.lipschitz) and seen.exactness == jf.IMPLICIT_ONLY
    assert np.isinf(jf.bounding_box(lambda p: p[0]).high).all()
    box = jf.Box((0.5, 0.3, 0.7))
    cut = jf.bounding_box(box - (lambda p: p[0]))
    np.testing.assert_array_equal(cut.high, box.half_extents)
    assert np.isnan(jf.lipschitz(box | (lambda p: p[0])))
    assert jf.bounding_box(~box).high[0] == 0.5


def test_wrong_parts_are_errors():
    with pytest.raises(ValueError, match="one coefficient for each"):
        jf.Polynomial(jnp.ones(2), ((0, 0, 0),))
    with pytest.raises(ValueError, match="of one kind"):
        jf.stack_fields([jf.Sphere(0.5), jf.Octahedron(0.5)])
    with pytest.raises(ValueError, match="vertices must have shape"):
        jf.Polygon(jnp.ones((4, 3)))
