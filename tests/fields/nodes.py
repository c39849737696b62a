"""One of every way to combine, deform, sample and write fields."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import fields as jf
from jaxgeom.shapes import Grid, TriangleMesh
from jaxgeom.transforms import Affine, Rigid, Similarity, rotation_exp

CENTER = (0.1, -0.2, 0.15)
STRETCH = ((1.3, 0.2, 0.0), (0.1, 0.7, 0.3), (0.0, -0.2, 0.9))


def combinations():
    """Booleans, fillets, offsets, moves and unions of many."""
    turn, shift = rotation_exp(jnp.array([0.3, -0.5, 0.7])), jnp.array([0.2, 0.1, -0.3])
    ball, box = jf.Sphere(0.5, CENTER), jf.Box((0.5, 0.3, 0.7))
    squashed = jf.Ellipsoid((0.7, 0.3, 0.5), CENTER)
    map_ = Affine(jnp.asarray(STRETCH), shift)
    radii = jnp.array([0.3, 0.2, 0.25])
    places = jnp.array([[0.3, 0.1, 0.0], [-0.3, 0.2, 0.1], [0.0, -0.4, 0.2]])
    balls = jax.vmap(jf.Sphere)(radii, places)
    fillets = [
        jf.QuadraticFillet(),
        jf.QuarticFillet(),
        jf.CircularFillet(),
        jf.ExponentialFillet(),
        jf.RootFillet(),
        jf.SigmoidFillet(),
    ]
    filled = {
        type(fillet).__name__: jf.SmoothUnion(ball, box, 0.3, fillet)
        for fillet in fillets
    }
    return filled | {
        "union": ball | box,
        "intersection": ball & box,
        "difference": box - ball,
        "xor": ball ^ box,
        "complement": ~box,
        "hole": ~(~ball | ~squashed),
        "blend": squashed.blend(box, 0.3),
        "smooth_and": ball.smooth_and(box, 0.3),
        "smooth_sub": box.smooth_sub(ball, 0.3),
        "many": jf.UnionOfMany((ball, box, squashed), 0.2),
        "stacked": jf.UnionOfMany(balls, 0.2),
        "plain_many": jf.UnionOfMany(balls),
        "offset": squashed.offset(0.1),
        "shrunk": box.offset(-0.1),
        "rounded": box.rounded(0.1),
        "shell": squashed.shell(0.1),
        "box_shell": box.shell(0.1),
        "rigid": box.transformed(Rigid(turn, shift)),
        "similar": squashed.transformed(Similarity(jnp.asarray(0.6), turn, shift)),
        "affine": box.transformed(map_),
        "grown_affine": squashed.transformed(map_).offset(0.1),
        "turned_slab": jf.Slab((1.0, 0.0, 0.0), 0.4).rotate(turn),
        "statue": jf.demo_statue(),
        "declared": jf.declare(lambda p: 0.5 * p[0] - 0.1 * p[1], lipschitz=0.6),
    }


def deformations():
    """Space bent, repeated and pulled apart."""
    bar, ball = jf.Box((0.6, 0.15, 0.2), (0.1, 0.05, 0.0)), jf.Sphere(0.2, (0.05, 0, 0))
    post = jf.Box((0.3, 0.2, 0.7), (0.1, 0.0, 0.2))
    ripple = jf.declare(
        lambda p: 0.05 * jnp.sin(5 * p[0]) * jnp.sin(4 * p[1]), lipschitz=0.33
    )
    return {
        "elongated": jf.Torus(0.4, 0.15).elongate((0.3, 0.0, 0.2)),
        "twisted": post.twist(2.0),
        "bent": bar.bend(1.3),
        "tapered": post.taper(1.2, 0.5),
        "displaced": ball.displace(ripple, 0.05),
        "morphed": post.morph(ball, 0.3),
        "mirrored": bar.mirror((1.0, 0.4, 0.3), 0.2),
        "repeated": ball.repeat((0.7, 0.8, 0.75)),
        "row": ball.repeat((0.7, 1.0, 0.8), (4, 1, 3)),
        "around": jf.Sphere(0.2, (0.6, 0.05, 0.1)).repeat_around(5),
    }


def written():
    """Polynomials, periodic surfaces, metaballs, samples, meshes, L-systems."""
    spacing = jnp.array([0.3, 0.25, 0.4])
    grid = Grid(jnp.array([-1.0, -0.9, -1.1]), spacing, (7, 8, 6))
    values = jf.sample(jf.Torus(0.55, 0.3), grid)
    solid = jf.Octahedron(0.7)
    faces = np.asarray(solid.faces(), np.int32)
    mesh = TriangleMesh(solid.corners() + jnp.asarray(CENTER), jnp.asarray(faces))
    low, high = (-1.2, -1.3, -1.4), (1.4, 1.3, 1.2)
    centers = jnp.array([[0.2, 0.1, 0.0], [-0.3, 0.2, 0.1], [0.0, -0.3, 0.2]])
    bush = jf.LSystem("X", (("X", "F[+!X]/[-!X]"),), 30.0, 0.4, 0.1)
    ball = jf.declare(lambda p: jax.nn.sigmoid(1 - 4 * jnp.sum(p * p)))
    return {
        "heart": jf.heart().within(low, high),
        "barth": jf.barth_sextic().within(low, high),
        "cyclide": jf.dupin_cyclide().within((-2, -2, -1), (2, 2, 1)),
        "gyroid": jf.gyroid(1.3, 0.2),
        "schwarz_p": jf.schwarz_p(1.3, 0.2),
        "schwarz_d": jf.schwarz_d(1.3, 0.2),
        "neovius": jf.neovius(1.3, 0.2),
        "periodic": jf.gyroid(1.3).body,
        "metaballs": jf.Metaballs(centers, (0.6, 0.5, 0.4), (1.0, 0.9, -0.5), 0.3),
        "cloud": jf.PointCloudField(centers, 0.2),
        "sampled": jf.Sampled(grid, values),
        "tricubic": jf.CubicSampled(grid, values),
        "mesh": jf.MeshDistance(mesh),
        "bush": bush.branches(3),
        "filled_bush": eqx_width(bush.branches(3), 0.1),
        "occupancy": jf.Occupancy(ball, 0.4),
    }


def eqx_width(branches, width):
    """The same branches with their forks filled."""
    parts = branches.starts, branches.ends, branches.start_radii, branches.end_radii
    return jf.Branches(*parts, width)
