"""One surface of every kind, with what is known of it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import parametric as jp
from jaxgeom.transforms import Similarity, rotation_exp

PI = np.pi


@dataclasses.dataclass(frozen=True)
class Known:
    """Euler characteristic of the tessellation, its kind, area and volume."""

    euler: int
    closed: bool = False
    oriented: bool = True
    area: float | None = None
    volume: float | None = None


def saddle(uv):
    u, v = uv
    return jnp.stack([0.8 * u, 1.1 * v, 0.6 * u * v + 0.2 * jnp.sin(3 * u)])


def net(seed=0, shape=(6, 5), crease=True):
    """A wavy rational patch of degrees 3 and 2, with a double knot or without."""
    generator = np.random.default_rng(seed)
    u, v = np.meshgrid(*(np.linspace(0, 1, n) for n in shape), indexing="ij")
    control = np.stack([1.3 * u, 0.9 * v, 0.2 * generator.normal(size=shape)], -1)
    weights = generator.uniform(0.6, 1.7, shape)
    one = jp.SplineBasis([0, 0, 0, 0, 0.35, 0.6, 1, 1, 1, 1], 3)
    inner = (0.1, 0.1) if crease else (0.1, 0.6)
    two = jp.SplineBasis([-0.5, -0.5, -0.5, *inner, 1.2, 1.2, 1.2], 2)
    return jp.NurbsSurface(jnp.asarray(control), (one, two), jnp.asarray(weights))


def _moved():
    """An ellipsoid turned, scaled by 1.7 and moved."""
    rotation = rotation_exp(np.array([0.3, -0.5, 0.9]))
    scaled = Similarity(jnp.asarray(1.7), rotation, jnp.array([0.4, -0.3, 0.2]))
    return jp.MovedSurface(jp.Sphere(0.6, (0.2, 0.1, -0.3)), scaled)


def surfaces():
    """Name -> surface and what is known of it."""
    arc = jp.Arc(0.3, -2.0, 2.0, (0.8, 0.0, 0.1))
    line = jp.Line((0.0, 0.0, 0.0), (0.0, 0.0, 1.4))
    r, big, small = 0.7, 1.3, 0.4
    torus = Known(0, True, True, 4 * PI**2 * big * small, 2 * PI**2 * big * small**2)
    ball = Known(2, True, True, 4 * PI * r**2, 4 / 3 * PI * r**3)
    side = np.hypot(0.5, 0.8)
    tube = jp.Swept(jp.Helix(1.1, 0.6, 1.25), jp.Circle(0.2), stations=16)
    arc_length, helix = 0.2 * 2 * PI, np.hypot(1.1, 0.6 / (2 * PI)) * 2.5 * PI
    shell = 0.6 * 1.7 + 0.25
    return {
        "patch": (
            jp.Patch((0.1, 0.2, 0.3), (1.2, 0, 0.1), (0.2, 0.7, 0)),
            Known(
                1, area=float(np.linalg.norm(np.cross((1.2, 0, 0.1), (0.2, 0.7, 0))))
            ),
        ),
        "sphere": (jp.Sphere(r, (0.1, -0.2, 0.3)), ball),
        "ellipsoid": (
            jp.Ellipsoid((0.7, 0.4, 0.5), (0.2, 0.1, 0)),
            Known(2, True, True, None, 4 / 3 * PI * 0.7 * 0.4 * 0.5),
        ),
        "torus": (jp.Torus(big, small, (0.3, 0.1, -0.2)), torus),
        "cylinder": (jp.Cylinder(0.6, 1.7), Known(0, area=2 * PI * 0.6 * 1.7)),
        "cone": (jp.Cone(0.5, 0.8, (0.1, 0, 0)), Known(1, area=PI * 0.5 * side)),
        "moebius strip": (jp.MoebiusStrip(1.3, 0.35), Known(0, oriented=False)),
        "klein bottle": (jp.KleinBottle(1.4, 0.4), Known(0, True, False)),
        "revolution": (
            jp.Revolution(arc),
            # Pappus: the arc of angle 4 turned about the axis.
            Known(0, area=2 * PI * (0.8 * 4 * 0.3 + 0.3**2 * 2 * np.sin(2))),
        ),
        "helicoid": (jp.Ruled(line, jp.Helix(0.9, 1.4)), Known(1)),
        "tube": (tube, Known(0, area=arc_length * helix)),
        "offset": (
            jp.Offset(_moved(), 0.25),
            Known(2, True, True, 4 * PI * shell**2, 4 / 3 * PI * shell**3),
        ),
        "function": (
            jp.FunctionSurface(saddle, jp.Domain(jp.Interval(-1, 0.7), jp.Interval())),
            Known(1),
        ),
        "nurbs": (net(), Known(1)),
        "nurbs sphere": (jp.nurbs_sphere(r, (0.1, -0.2, 0.3)), ball),
        "nurbs torus": (jp.nurbs_torus(big, small), torus),
    }


def parameters(surface, number, seed=0):
    """Random (u, v) [number, 2] strictly inside the domain."""
    domain = surface.domain()
    low = np.array([domain.u.low, domain.v.low])
    high = np.array([domain.u.high, domain.v.high])
    share = np.random.default_rng(seed).uniform(0.03, 0.97, (number, 2))
    return jnp.asarray(low + share * (high - low))


def in_dtype(tree, dtype):
    """All floating arrays of a pytree in another precision."""
    cast = lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x
    return jax.tree.map(cast, tree)


@dataclasses.dataclass(frozen=True)
class Counted:
    """What a list of faces is, counted edge by edge."""

    euler: int
    closed: bool
    oriented: bool
    manifold: bool
    boundary_loops: int


def counted(faces) -> Counted:
    """Euler characteristic, borders and defects of faces [f, 3], by plain counting."""
    faces = np.asarray(faces)
    assert len(np.unique(np.sort(faces, axis=1), axis=0)) == len(faces)
    directed = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    edges, times = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    once = len(np.unique(directed, axis=0)) == len(directed)
    border = edges[times == 1]
    _, uses = np.unique(border, return_counts=True)
    return Counted(
        euler=len(np.unique(faces)) - len(edges) + len(faces),
        closed=len(border) == 0,
        oriented=once,
        manifold=bool((times <= 2).all() and (uses == 2).all()),
        boundary_loops=_pieces(border),
    )


def _pieces(edges):
    """The number of connected sets of edges."""
    names = {}

    def root(i):
        while names.setdefault(i, i) != i:
            i = names[i]
        return i

    for a, b in edges.tolist():
        names[root(a)] = root(b)
    return len({root(i) for i in list(names)})
