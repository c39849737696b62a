"""One picture of twenty fields, each traced by its own Lipschitz constant.

python experiments/fields/gallery.py gallery.png
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import fields as jf
from jaxgeom import render
from jaxgeom.transforms import rotation_exp

COLUMNS, SIZE = 5, 200


def bodies():
    """Name and field; all are found in and around the unit ball, z up."""
    ball = jf.Sphere(1.0)
    lying = rotation_exp(jnp.array([np.pi / 2, 0.0, 0.0]))
    sitting = rotation_exp(jnp.array([0.0, 0.0, np.pi / 2]))
    core = jf.Box((0.6, 0.6, 0.6)).rounded(0.05) & jf.Sphere(0.85)
    pipe = jf.Cylinder(0.35, 1.0)
    pipes = pipe | pipe.rotate(lying) | pipe.rotate(lying).rotate(sitting)
    drops = jnp.array(
        [[0.4, 0, -0.3], [-0.4, 0.2, -0.2], [0, -0.2, 0.4], [0.1, 0.5, 0]]
    )
    return {
        "solid geometry": core.smooth_sub(pipes, 0.1),
        "gear": (jf.Gear(0.7, 0.9, 14) - jf.Circle(0.25)).extrude(0.2).rotate(lying),
        "star, revolved": jf.Star(0.35, 0.16).rounded(0.03).revolve(0.55),
        "heart, extruded": jf.Heart(1.2)
        .extrude(0.2)
        .rounded(0.1)
        .rotate(lying)
        .translate((0, 0, -0.8)),
        "box frame": jf.BoxFrame((0.7, 0.5, 0.6), 0.12).rounded(0.03),
        "links": jf.Link(0.17, 0.18, 0.06)
        | jf.Link(0.17, 0.18, 0.06).rotate(sitting).translate((0, 0, 0.58))
        | jf.Link(0.17, 0.18, 0.06).rotate(sitting).translate((0, 0, -0.58)),
        "dodecahedron": jf.Dodecahedron(0.9),
        "star to circle": jf.Lofted(jf.Star(0.8, 0.4), jf.Circle(0.3), 0.7),
        "death star": jf.DeathStar(0.85, 0.5, 1.0).rotate(
            rotation_exp(jnp.array([0.9, 0.0, -0.5]))
        ),
        "twisted": jf.Box((0.35, 0.35, 0.8)).rounded(0.06).twist(1.6),
        "bent": jf.Prism(0.25, 0.95, 6)
        .rotate(sitting @ lying @ sitting)
        .bend(1.2)
        .rotate(lying)
        .translate((0, 0, -0.4)),
        "around": jf.RoundTube((0.25, 0, 0), (0.75, 0, 0.3), 0.1, 0.2)
        .repeat_around(7)
        .blend(jf.Sphere(0.3), 0.2),
        "metaballs": jf.Metaballs(
            drops, (0.7, 0.6, 0.7, 0.5), (1.0, 1.0, 1.0, 1.0), 0.3
        ),
        "tanglecube": jf.tanglecube().within((-2.6,) * 3, (2.6,) * 3).scale(0.3),
        "Barth sextic": ~jf.barth_sextic().within((-1.6,) * 3, (1.6,) * 3).scale(0.6)
        & ball,
        "Clebsch cubic": jf.clebsch_cubic()
        .within((-3.0,) * 3, (3.0,) * 3)
        .scale(0.33)
        .shell(0.06)
        & ball,
        "Kummer quartic": jf.kummer_quartic()
        .within((-3.0,) * 3, (3.0,) * 3)
        .scale(0.33)
        & ball,
        "Dupin cyclide": jf.dupin_cyclide()
        .within((-2, -2, -1), (2, 2, 1))
        .scale(0.5)
        .rotate(rotation_exp(jnp.array([0.6, 0.0, 0.0]))),
        "gyroid": jf.gyroid(0.9).shell(0.06) & ball.offset(-0.05),
        "L-system": jf.demo_bush().branches(5).scale(0.5).translate((0, 0, -0.9)),
    }


def picture(field):
    """One body, traced by its value over its Lipschitz constant."""
    steep = jf.lipschitz(field)
    slowed = Slowed(field, jnp.maximum(steep, 1))
    camera = jf.Camera((1.9, -3.6, 1.9), field_of_view=30.0)
    return render.render_field(slowed, camera, size=(SIZE, SIZE), max_steps=768)


class Slowed(jf.AbstractField):
    """f / L: steps of this size never pass the surface."""

    body: jf.AbstractField
    steep: jax.Array

    def evaluate(self, point):
        return self.body(point) / self.steep

    def claims(self):
        return self.body.claims().weakened(lipschitz=jnp.ones(()))


def main(path):
    """Render all and write one PNG."""
    tiles = []
    for name, field in bodies().items():
        tiles.append(picture(field))
        box = jf.bounding_box(field)
        print(f"{name:18} L {float(jf.lipschitz(field)):6.2f}", box.low, box.high)
    rows = [np.hstack(tiles[i : i + COLUMNS]) for i in range(0, len(tiles), COLUMNS)]
    render.save_png(path, np.vstack(rows))


if __name__ == "__main__":
    main(sys.argv[1])
