"""A family of robed figures on a pedestal: the training set of the learned road."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxgeom import Grid, PointCloud, isosurface, learning, meshes
from jaxgeom.fields import Capsule, Cylinder, Ellipsoid, Sphere, demo_statue

SCALE = 0.45  # the figures are about 2 high; networks want about 1
NUM_PARAMETERS = 14
CELLS = 72
GRID = Grid(
    jnp.full(3, -0.56, jnp.float32), jnp.full(3, 1.12 / CELLS), (CELLS + 1,) * 3
)
CAPACITY = isosurface.Capacity.holding(6000, 12000, 6000)


def figure(u):
    """The figure with parameters u [14] in [-1, 1]: height 2, z up, facing -y."""
    foot = Cylinder(0.42 + 0.06 * u[0], 0.06, (0.0, 0.0, -0.9))
    skirt = Ellipsoid(
        jnp.stack([0.28 + 0.06 * u[1], 0.24 + 0.04 * u[2], 0.48 + 0.04 * u[3]]),
        (0.0, 0.0, -0.44),
    )
    torso = Ellipsoid((0.165, 0.13, 0.27), (0.0, 0.0, 0.13))
    wide = 0.17 + 0.04 * u[4]
    at = lambda x, y, z: jnp.stack([jnp.asarray(c, float) for c in (x, y, z)])
    shoulders = Capsule(at(-wide, 0, 0.27), at(wide, 0, 0.27), 0.07)
    top = 0.58 + 0.05 * u[5]
    neck = Capsule(at(0, 0, 0.3), at(0, -0.01, top - 0.12), 0.055)
    head = Ellipsoid(
        jnp.stack([0.105 + 0.02 * u[6], 0.12 + 0.02 * u[6], 0.14 + 0.02 * u[7]]),
        at(0, -0.02, top),
    )
    bun = Sphere(0.06 + 0.02 * u[8], at(0, 0.11, top + 0.07))
    body = foot.blend(skirt, 0.1).blend(torso, 0.12).blend(shoulders, 0.15)
    body = body.blend(neck.blend(head, 0.08).blend(bun, 0.05), 0.08)
    right, _ = _arm(wide, u[9], u[10], at)
    left, hand = _arm(-wide, u[11], u[12], at)
    orb = Sphere(0.08 + 0.03 * u[13], hand)
    arms = right.blend(left.blend(orb, 0.05), 0.05)
    return body.blend(arms, 0.08).scale(SCALE)


def _arm(shoulder, raised, bent, at):
    """Two capsules: the elbow and the hand go up with the parameters."""
    side = jnp.sign(shoulder)
    elbow = at(shoulder + 0.2 * side, -0.05, 0.17 + 0.14 * raised)
    hand = at(shoulder + 0.25 * side, -0.16 - 0.08 * bent, 0.3 + 0.26 * bent)
    upper = Capsule(at(shoulder, 0, 0.27), elbow, 0.06)
    return upper.blend(Capsule(elbow, hand, 0.05), 0.06), hand


def statue():
    """The statue of the museum: no member of the family (it holds a ring)."""
    return demo_statue().scale(SCALE)


def parameters(num, seed):
    """Random parameters [num, 14]."""
    shape = (num, NUM_PARAMETERS)
    return jax.random.uniform(jax.random.key(seed), shape, minval=-1.0, maxval=1.0)


@eqx.filter_jit
def mesh_of(field):
    """The true surface, as a mesh of fixed capacity."""
    values = jax.lax.map(jax.vmap(jax.vmap(field)), GRID.nodes())
    return isosurface.marching_cubes(values, GRID, 0.0, capacity=CAPACITY)


@functools.partial(jax.jit, static_argnums=2)
def lesson(mesh, key, num):
    """What a network is taught of one shape: `num` distances, and points on it."""
    key_space, key_surface = jax.random.split(key)
    spreads = (0.005, 0.03)
    samples = learning.signed_samples(mesh, num, key=key_space, spreads=spreads)
    cloud = meshes.sample_surface(mesh, 1024, key=key_surface).cloud()
    return samples, cloud


def lessons(num_shapes, num_samples, seed):
    """Samples [s, m] and clouds [s, 1024] of random members of the family."""
    keys = jax.random.split(jax.random.key(seed + 1), num_shapes)
    rows = []
    for u, key in zip(parameters(num_shapes, seed), keys, strict=True):
        found = mesh_of(figure(u))
        rows.append(lesson(found.mesh, key, num_samples))
    return jax.tree.map(lambda *x: jnp.stack(x), *rows)


def scan(mesh, num, key, *, front_only=False):
    """`num` random points of a mesh with normals; of its front (y < 0) alone."""
    many = meshes.sample_surface(mesh, 40 * num, key=key)
    seen = many.points[:, 1] < 0 if front_only else many.mask
    rows = jnp.nonzero(seen, size=num)[0]
    return PointCloud(many.points[rows], many.normals[rows])
