"""One of every primitive and shape, none of them unit-sized."""

import jax.numpy as jnp
import numpy as np

from jaxgeom import fields as jf

CENTER = (0.1, -0.2, 0.15)
RNG = np.random.default_rng(7)


def solids():
    """Bodies in space."""
    hull = RNG.normal(size=(12, 3)) * [0.6, 0.4, 0.5]
    normals = np.concatenate([np.eye(3), -np.eye(3), [[1.0, 1.2, 0.7]]])
    offsets = np.array([0.5, 0.4, 0.6, 0.45, 0.3, 0.5, 0.55])
    chain = jnp.array([[-0.5, 0.1, 0.2], [0.1, 0.4, -0.2], [0.5, -0.3, 0.1]])
    square = jnp.array(
        [[0, 0, 0.1], [0.6, 0.1, 0.1], [0.5, 0.5, 0.1], [-0.1, 0.4, 0.1]]
    )
    return {
        "sphere": jf.Sphere(0.63, CENTER),
        "box": jf.Box((0.5, 0.3, 0.7), CENTER),
        "rounded_box": jf.RoundedBox((0.5, 0.4, 0.7), 0.13, CENTER),
        "box_frame": jf.BoxFrame((0.5, 0.4, 0.7), 0.12, CENTER),
        "torus": jf.Torus(0.55, 0.21, CENTER),
        "capped_torus": jf.CappedTorus(0.55, 0.17, 1.1),
        "wide_torus": jf.CappedTorus(0.55, 0.17, 2.3),
        "link": jf.Link(0.3, 0.4, 0.11),
        "cylinder": jf.Cylinder(0.45, 0.33, CENTER),
        "rounded_cylinder": jf.RoundedCylinder(0.45, 0.33, 0.1),
        "infinite_cylinder": jf.InfiniteCylinder(0.45),
        "capsule": jf.Capsule((-0.4, 0.1, 0.2), (0.5, -0.3, 0.1), 0.23),
        "round_tube": jf.RoundTube((-0.4, 0.1, 0.2), (0.5, -0.3, 0.1), 0.3, 0.1),
        "cone": jf.Cone(0.4, 0.7),
        "infinite_cone": jf.InfiniteCone(0.6),
        "capped_cone": jf.CappedCone(0.5, 0.2, 0.35),
        "round_cone": jf.RoundCone(0.4, 0.15, 0.6),
        "plane": jf.Plane((1.0, 2.0, -0.7), 0.2),
        "slab": jf.Slab((1.0, 2.0, -0.7), 0.3, 0.1),
        "ellipsoid": jf.Ellipsoid((0.7, 0.4, 0.5), CENTER),
        "exact_ellipsoid": jf.ExactEllipsoid((0.7, 0.3, 0.5), CENTER),
        "octahedron": jf.Octahedron(0.7),
        "tetrahedron": jf.Tetrahedron(0.8),
        "icosahedron": jf.Icosahedron(0.7),
        "dodecahedron": jf.Dodecahedron(0.6),
        "pyramid": jf.Pyramid(0.4, 0.7),
        "hull": jf.ConvexSolid.hull(hull),
        "polytope": jf.Polytope(normals, offsets),
        "prism6": jf.Prism(0.5, 0.3, 6),
        "prism3": jf.Prism(0.6, 0.25, 3),
        "solid_angle": jf.SolidAngle(0.6, 0.7),
        "wide_angle": jf.SolidAngle(0.6, 2.2),
        "cut_sphere": jf.CutSphere(0.6, 0.25),
        "deep_cut_sphere": jf.CutSphere(0.6, -0.25),
        "cut_hollow_sphere": jf.CutHollowSphere(0.6, 0.25, 0.1),
        "death_star": jf.DeathStar(0.6, 0.4, 0.7),
        "spindle": jf.Spindle(0.8, 0.45),
        "triangle": jf.ThickPolygon(chain, 0.08),
        "quad": jf.ThickPolygon(square, 0.06),
        "polyline": jf.Polyline(chain, 0.1),
        "bezier": jf.Bezier(chain * jnp.array([1.0, 2.0, 1.0]), 0.08),
        "extruded": jf.Heart(0.8).extrude(0.2),
        "revolved": jf.Star(0.3, 0.15).revolve(0.6),
        "lofted": jf.Lofted(jf.Star(0.6, 0.4), jf.Circle(0.3), 0.4),
    }


def profiles():
    """Shapes of the plane."""
    chain = jnp.array([[-0.5, 0.1], [0.1, 0.4], [0.5, -0.3]])
    hook = jnp.array([[-0.5, -0.4], [0.6, -0.3], [0.1, 0.0], [0.5, 0.5], [-0.3, 0.35]])
    return {
        "circle": jf.Circle(0.63, (0.1, -0.2)),
        "ellipse": jf.Ellipse((0.7, 0.3), (0.1, -0.2)),
        "ring": jf.Ring(0.5, 0.2),
        "rectangle": jf.Rectangle((0.5, 0.3), (0.1, -0.2)),
        "rounded_rectangle": jf.RoundedRectangle((0.5, 0.3), 0.1, (0.1, -0.2)),
        "triangle2": jf.Triangle(chain[0], chain[2], chain[1]),
        "chamfered_rectangle": jf.ChamferedRectangle((0.5, 0.3), 0.1),
        "stairs": jf.Stairs((0.3, 0.2), 3),
        "rounded_cross": jf.RoundedCross((0.7, 0.5)),
        "parabola": jf.Parabola(1.3),
        "polygon": jf.Polygon(hook),
        "clockwise": jf.Polygon(hook[::-1]),
        "trapezoid": jf.Trapezoid(0.6, 0.3, 0.4),
        "parallelogram": jf.Parallelogram((0.5, 0.3), 0.2),
        "rhombus": jf.Rhombus((0.6, 0.35)),
        "hexagon": jf.RegularPolygon(0.6, 6),
        "star": jf.Star(0.7, 0.3),
        "cross": jf.Cross(0.6, 0.17),
        "gear": jf.Gear(0.5, 0.65, 9),
        "pie": jf.Pie(0.6, 0.7),
        "wide_pie": jf.Pie(0.6, 2.2),
        "cut_disk": jf.CutDisk(0.6, 0.25),
        "horseshoe": jf.Horseshoe(0.5, 0.2, 0.6),
        "vesica": jf.Vesica(0.8, 0.45),
        "moon": jf.Moon(0.6, 0.4, 0.5),
        "uneven_capsule": jf.UnevenCapsule(0.4, 0.15, 0.6),
        "egg": jf.Egg(0.5, 0.2),
        "tunnel": jf.Tunnel(0.4, 0.3),
        "heart": jf.Heart(0.8),
        "arc": jf.Arc(0.55, 0.1, 1.1),
        "polyline2": jf.Polyline(chain, 0.1),
        "bezier2": jf.Bezier(chain * jnp.array([1.0, 2.0]), 0.08),
    }
