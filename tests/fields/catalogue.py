"""One of every field, none of them unit-sized, centered or axis-aligned."""

import jax.numpy as jnp
import numpy as np

from jaxgeom import fields as jf
from jaxgeom.shapes import Grid
from jaxgeom.transforms import Affine, Rigid, Similarity, rotation_exp

TURN = np.array([0.3, -0.5, 0.7])
CENTER = (0.1, -0.2, 0.15)
STRETCH = np.array([[1.3, 0.2, 0.0], [0.1, 0.7, 0.3], [0.0, -0.2, 0.9]])


def exact():
    """Fields whose value is the signed distance, everywhere."""
    turn, shift = rotation_exp(jnp.asarray(TURN)), jnp.array([0.2, 0.1, -0.3])
    capsule = jf.Capsule((-0.4, 0.1, 0.2), (0.5, -0.3, 0.1), 0.23)
    box = jf.Box((0.5, 0.3, 0.7), CENTER)
    return {
        "sphere": jf.Sphere(0.63, CENTER),
        "box": box,
        "rounded_box": jf.RoundedBox((0.5, 0.4, 0.7), 0.13, CENTER),
        "torus": jf.Torus(0.55, 0.21, CENTER),
        "capsule": capsule,
        "point_capsule": jf.Capsule(CENTER, CENTER, 0.4),
        "cylinder": jf.Cylinder(0.45, 0.33, CENTER),
        "plane": jf.Plane((1.0, 2.0, -0.7), 0.2),
        "complement": ~capsule,
        "rigid": box.transformed(Rigid(turn, shift)),
        "turned": box.rotate(turn).translate(shift),
        "similar": box.transformed(Similarity(jnp.asarray(0.6), turn, shift)),
        "scaled": capsule.scale(1.7),
        "offset": capsule.offset(0.1),
    }


def bounds():
    """Fields with Lipschitz constant 1 that are not distances everywhere."""
    sphere, box = jf.Sphere(0.5, CENTER), jf.Box((0.5, 0.3, 0.7))
    map_ = Affine(jnp.asarray(STRETCH), jnp.array([0.1, 0.2, -0.1]))
    return {
        "ellipsoid": jf.Ellipsoid((0.7, 0.4, 0.5), CENTER),
        "union": sphere | box,
        "intersection": sphere & box,
        "difference": box - sphere,
        "blend": sphere.blend(box, 0.3),
        "unblended": sphere.blend(box, 0.0),
        "shell": box.shell(0.1),
        "affine": box.transformed(map_),
        "statue": jf.demo_statue(),
    }


def sampled():
    """A field on a grid with three different sizes and spacings."""
    spacing = jnp.array([0.3, 0.25, 0.4])
    grid = Grid(jnp.array([-1.0, -0.9, -1.1]), spacing, (7, 8, 6))
    return jf.Sampled(grid, jf.sample(jf.Torus(0.55, 0.3), grid))


def all_fields():
    return exact() | bounds() | {"sampled": sampled()}


def random_points(count, seed=0):
    return np.random.default_rng(seed).uniform(-1.3, 1.3, (count, 3))
