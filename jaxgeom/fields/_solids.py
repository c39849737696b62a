"""Convex bodies with flat faces, from corners and faces or from planes.

Outside, the nearest face is found by its border: the distance is that to its plane
where the foot lies within the face, and else that to its nearest edge. Inside, the
nearest plane decides.
"""

import itertools
import math
from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._core import safe_divide, safe_norm, safe_normalize
from ._claims import Bounds, Claims, Trust
from ._field import AbstractField
from ._parameters import array, scalar, vector


class AbstractSolid(AbstractField):
    """A convex body given by its corners and faces. Exact distance."""

    @abstractmethod
    def corners(self) -> Float[Array, "v 3"]:
        """The corners."""

    @abstractmethod
    def faces(self) -> tuple[tuple[int, ...], ...]:
        """The corners of every face, counter-clockwise seen from outside."""

    def evaluate(self, point):
        faces = self.corners()[padded_loops(self.faces())]
        heights, gaps = jax.vmap(lambda face: face_distance(face, point))(faces)
        deepest = jnp.max(heights)
        nearest = jnp.argmin(gaps)
        return jnp.where(deepest > 0, gaps[nearest], deepest)

    def claims(self):
        corners = self.corners()
        low, high = jnp.min(corners, axis=0), jnp.max(corners, axis=0)
        return Claims.distance(Bounds.of(low, high))


class ConvexSolid(AbstractSolid):
    """The convex body with `vertices` [n, 3] and `loops` (static), the corners of every
    face counter-clockwise seen from outside. Exact distance.

    `ConvexSolid.hull(points)` finds both.
    """

    vertices: Float[Array, "n 3"] = eqx.field(converter=array("vertices", None, 3))
    loops: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @staticmethod
    def hull(points: Float[Array, "n 3"]) -> "ConvexSolid":
        """The convex hull of points (host: scipy)."""
        from scipy.spatial import ConvexHull

        points = np.asarray(points)
        found = ConvexHull(points)
        corners = points[found.simplices]
        turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outward = np.sum(turned * found.equations[:, :3], axis=1) > 0
        faces = np.where(outward[:, None], found.simplices, found.simplices[:, ::-1])
        kept, renamed = np.unique(faces, return_inverse=True)
        loops = renamed.reshape(faces.shape).tolist()
        return ConvexSolid(points[kept], tuple(map(tuple, loops)))

    def corners(self):
        return self.vertices

    def faces(self):
        return self.loops


class Polytope(AbstractField):
    """max_i (n_i . x - offset_i), n = normal / |normal|: what lies under all planes.

    Exact inside, a lower bound outside. Its box is that of the corners of the planes
    taken three at a time, O(n^4) in their number; infinite where a direction is open.
    """

    normals: Float[Array, "n 3"] = eqx.field(converter=array("normals", None, 3))
    offsets: Float[Array, " n"] = eqx.field(converter=array("offsets", None))

    def evaluate(self, point):
        return jnp.max(safe_normalize(self.normals) @ point - self.offsets)

    def claims(self):
        # Nothing is said of how fast a blunt corner recedes when the planes move.
        low, high = _box_of_planes(safe_normalize(self.normals), self.offsets)
        part = Claims.distance(Bounds.of(low, high, 0.0))
        return part.trusted(Trust.BOUND, Trust.EXACT)


class Octahedron(AbstractSolid):
    """|x| + |y| + |z| <= radius, corners on the axes. Exact distance."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def corners(self):
        return self.radius * jnp.asarray(_AXES, self.radius.dtype)

    def faces(self):
        return _OCTAHEDRON_FACES


class Tetrahedron(AbstractSolid):
    """The regular tetrahedron with corners at `radius` from the origin.

    Two edges are parallel to the plane z = 0. Exact distance.
    """

    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def corners(self):
        return _on_sphere(_TETRAHEDRON, self.radius)

    def faces(self):
        return _TETRAHEDRON_FACES


class Icosahedron(AbstractSolid):
    """The regular icosahedron with corners at `radius` from the origin. Exact."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def corners(self):
        return _on_sphere(_ICOSAHEDRON, self.radius)

    def faces(self):
        return _ICOSAHEDRON_FACES


class Dodecahedron(AbstractSolid):
    """The regular dodecahedron with corners at `radius` from the origin. Exact."""

    radius: Float[Array, ""] = eqx.field(converter=scalar)

    def corners(self):
        return _on_sphere(_DODECAHEDRON, self.radius)

    def faces(self):
        return _DODECAHEDRON_FACES


class Pyramid(AbstractSolid):
    """The pyramid on the square of half width `half_base` in z = 0, with its apex at
    z = `height`. Exact distance."""

    half_base: Float[Array, ""] = eqx.field(converter=scalar)
    height: Float[Array, ""] = eqx.field(converter=scalar)

    def corners(self):
        square = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], float)
        base = self.half_base * jnp.asarray(square, self.half_base.dtype)
        zero = jnp.zeros_like(self.height)
        return jnp.concatenate([base, jnp.stack([zero, zero, self.height])[None]])

    def faces(self):
        return ((3, 2, 1, 0), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4))


class Slab(AbstractField):
    """|n . x - offset| - thickness/2, n = normal / |normal|. Exact distance."""

    normal: Float[Array, " 3"] = eqx.field(converter=vector("normal"))
    thickness: Float[Array, ""] = eqx.field(converter=scalar)
    offset: Float[Array, ""] = eqx.field(converter=scalar, default=0.0)

    def evaluate(self, point):
        height = jnp.dot(point, safe_normalize(self.normal)) - self.offset
        return jnp.abs(height) - self.thickness / 2

    def claims(self):
        return Claims.distance(Bounds.everywhere())


def padded_loops(loops) -> np.ndarray:
    """Faces as rows of one length: the last corner repeated makes edges of length 0."""
    longest = max(map(len, loops))
    return np.array([loop + loop[-1:] * (longest - len(loop)) for loop in loops])


def face_distance(corners: Float[Array, "k 3"], point: Float[Array, " 3"]):
    """(height above its plane, distance) of one flat convex face."""
    along = jnp.roll(corners, -1, axis=0) - corners
    gap = point - corners
    normal = safe_normalize(jnp.cross(corners[1] - corners[0], corners[2] - corners[0]))
    height = jnp.dot(gap[0], normal)
    within = jnp.all(jnp.cross(along, gap) @ normal >= 0)
    t = jnp.clip(safe_divide(jnp.sum(gap * along, 1), jnp.sum(along * along, 1)), 0, 1)
    border = jnp.min(safe_norm(gap - t[:, None] * along))
    return height, jnp.where(within, jnp.abs(height), border)


def _box_of_planes(normals, offsets):
    """(low, high) of the corners; infinite ends where the planes leave a way out."""
    n = normals.shape[0]
    triples = np.array(list(itertools.combinations(range(n), 3)))
    matrix, right = normals[triples], offsets[triples]
    across = jnp.cross(matrix[:, 1], matrix[:, 2])
    volume = jnp.sum(matrix[:, 0] * across, axis=1)
    tiny = jnp.finfo(normals.dtype).eps ** 0.5
    proper = jnp.abs(volume) > tiny
    sums = (
        right[:, :1] * across
        + right[:, 1:2] * jnp.cross(matrix[:, 2], matrix[:, 0])
        + right[:, 2:] * jnp.cross(matrix[:, 0], matrix[:, 1])
    )
    corner = sums / jnp.where(proper, volume, 1)[:, None]
    slack = tiny * (1 + jnp.max(jnp.abs(offsets)))
    real = proper & jnp.all(corner @ normals.T <= offsets + slack, axis=1)
    low = jnp.min(jnp.where(real[:, None], corner, jnp.inf), axis=0)
    high = jnp.max(jnp.where(real[:, None], corner, -jnp.inf), axis=0)
    # A way out exists along a crossing of two planes that no plane stops.
    pairs = normals[np.array(list(itertools.combinations(range(n), 2)))]
    rays = jnp.cross(pairs[:, 0], pairs[:, 1])
    rays = jnp.concatenate([rays, -rays])
    lasting = jnp.any(jnp.abs(rays) > tiny, axis=1)
    open_way = jnp.any(lasting & jnp.all(rays @ normals.T <= tiny, axis=1))
    ends = jnp.where(open_way | ~jnp.any(real), jnp.inf, 0)
    return jnp.where(ends > 0, -jnp.inf, low), jnp.where(ends > 0, jnp.inf, high)


def _on_sphere(corners, radius):
    unit = corners / np.linalg.norm(corners[0])
    return radius * jnp.asarray(unit, radius.dtype)


def _loops(corners: np.ndarray, normals: np.ndarray, sides: int):
    """The faces of a regular solid: its `sides` farthest corners along each normal."""
    return tuple(_loop(corners, n / np.linalg.norm(n), sides) for n in normals)


def _loop(corners, normal, sides):
    chosen = np.argsort(-corners @ normal)[:sides]
    spokes = corners[chosen] - corners[chosen].mean(axis=0)
    across = np.cross(normal, spokes[0])
    angles = np.arctan2(spokes @ across, spokes @ spokes[0])
    return tuple(int(i) for i in chosen[np.argsort(angles)])


def _cycled(pairs):
    """Points (0, a, b), (b, 0, a), (a, b, 0) for all pairs (a, b)."""
    return np.array([np.roll((0, *pair), i) for i in range(3) for pair in pairs])


_PHI = (1 + math.sqrt(5)) / 2
_CUBE = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_AXES = np.concatenate([np.eye(3), -np.eye(3)])
_TETRAHEDRON = _CUBE[np.prod(_CUBE, axis=1) > 0]
_SIGNS = list(itertools.product((-1, 1), repeat=2))
_ICOSAHEDRON = _cycled([(a, b * _PHI) for a, b in _SIGNS])
_SHORT = _cycled([(a / _PHI, b * _PHI) for a, b in _SIGNS])
_DODECAHEDRON = np.concatenate([_CUBE, _SHORT])
_OCTAHEDRON_FACES = _loops(_AXES, _CUBE, 3)
_TETRAHEDRON_FACES = _loops(_TETRAHEDRON, -_TETRAHEDRON, 3)
# Each of these two has the directions of the other's corners as its normals.
_ICOSAHEDRON_FACES = _loops(_ICOSAHEDRON, _DODECAHEDRON[:, [1, 0, 2]], 3)
_DODECAHEDRON_FACES = _loops(_DODECAHEDRON, _ICOSAHEDRON[:, [1, 0, 2]], 5)
