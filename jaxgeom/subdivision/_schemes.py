"""One level of each subdivision scheme, as sparse rows and the finer connectivity."""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from .._core import GeometryError, message
from ._creases import AbstractDecay, Rules, UniformDecay, inherit, rules_of
from ._net import Net, split_polygons, split_triangles
from ._operator import Rows, band_from_entries, even_band, identity_band


class AbstractScheme(eqx.Module):
    """A rule that takes a net to a finer one and says where its vertices lie."""

    @abc.abstractmethod
    def step(self, net: Net) -> tuple[tuple[Rows, ...], Net]:
        """The factors of one level, the first applied first, and the finer net."""


class AbstractLoopWeights(eqx.Module):
    """How much of each neighbor goes into a smooth vertex of Loop's scheme."""

    @abc.abstractmethod
    def __call__(self, n: Float[Array, "..."]) -> Float[Array, "..."]:
        """beta(n) for vertices of n >= 1 edges (numpy)."""


class Original(AbstractLoopWeights):
    """beta = (5/8 - (3/8 + cos(2 pi / n) / 4)^2) / n (Loop 1987; trimesh)."""

    def __call__(self, n):
        """beta(n)."""
        return (5 / 8 - (3 / 8 + np.cos(2 * np.pi / n) / 4) ** 2) / n


class Warren(AbstractLoopWeights):
    """beta = 3 / (8 n), and 3/16 for n = 3 (Warren 1995; libigl, Open3D)."""

    def __call__(self, n):
        """beta(n)."""
        return np.where(n == 3, 3 / 16, 3 / (8 * n))


class Loop(AbstractScheme):
    """Loop's scheme for triangles: four for each, C2 but at vertices of n != 6 edges.

    New vertex of an edge a b with opposite corners c, d: (3 a + 3 b + c + d) / 8. Old
    vertex: (1 - n beta) of itself and beta of each of its n neighbors. On the border
    and on creases (a + b) / 2 and 1/8, 6/8, 1/8: a cubic B-spline.

    **Arguments:** `weights`: beta(n), `Original()` or `Warren()`; `decay`: how
    sharpness passes on, `UniformDecay()` or `ChaikinDecay()`.

    Source: C. Loop, Smooth subdivision surfaces based on triangles, 1987; creases: H.
    Hoppe et al., Piecewise smooth surface reconstruction, 1994, DeRose et al. 1998.
    """

    weights: AbstractLoopWeights = Original()
    decay: AbstractDecay = UniformDecay()

    def step(self, net):
        """The factors of one level and the finer net."""
        _check_triangles(net)
        rules = rules_of(net, self.decay)
        n = np.maximum(net.valence, 1)
        beta = rules.smooth * self.weights(n)
        own = rules.smooth - n * beta + 0.75 * rules.crease + rules.fixed
        bands = _vertex_band(net, rules, own, beta), _loop_edges(net, rules)
        child = inherit(net, split_triangles(net), rules)
        return (Rows(bands, net.num_vertices),), child


class CatmullClark(AbstractScheme):
    """Catmull and Clark's scheme: any polygons become quadrilaterals at once.

    Face point: the mean of its corners. Edge point: the mean of its ends and of the
    points of its two faces. Old vertex of n edges: (F + 2 R + (n - 3) P) / n, F and R
    being the means of the points of its faces and of the middles of its edges. On the
    border and on creases (a + b) / 2 and 1/8, 6/8, 1/8: a cubic B-spline.

    **Arguments:** `decay`: how sharpness passes on, `UniformDecay()` or
    `ChaikinDecay()`.

    Source: E. Catmull and J. Clark, Computer-Aided Design 10, 1978; creases: T. DeRose,
    M. Kass, T. Truong, Subdivision surfaces in character animation, 1998.
    """

    decay: AbstractDecay = UniformDecay()

    def step(self, net):
        """The factors of one level (face points, then the rest) and the finer net."""
        rules = rules_of(net, self.decay)
        v, f = net.num_vertices, net.sizes.size
        n = np.maximum(net.valence, 1)
        around = rules.smooth / n**2
        own = rules.smooth * (n - 2) / n + 0.75 * rules.crease + rules.fixed
        faces = (net.corners, v + net.face, around[net.corners])
        bands = (
            _vertex_band(net, rules, own, around, [faces], columns=v + f),
            _catmull_clark_edges(net, rules),
            identity_band(v, v + f),
        )
        child = inherit(net, split_polygons(net), rules)
        return (_with_centroids(net), Rows(bands, v + f)), child


class Midpoint(AbstractScheme):
    """Every triangle in four without moving anything: shape and interpolants stay.

    New vertex of an edge: (a + b) / 2.
    """

    def step(self, net):
        """The factors of one level and the finer net."""
        _check_triangles(net)
        v = net.num_vertices
        rows = Rows((identity_band(0, v), _middles(net)), v)
        return (rows,), inherit(
            net, split_triangles(net), rules_of(net, UniformDecay())
        )


class Bilinear(AbstractScheme):
    """Every polygon of k corners in k quadrilaterals around the mean of its corners.

    Old vertices stay; new vertex of an edge: (a + b) / 2.
    """

    def step(self, net):
        """The factors of one level and the finer net."""
        v = net.num_vertices
        rows = Rows((identity_band(0, v), _middles(net), _centroids(net)), v)
        rules = rules_of(net, UniformDecay())
        return (rows,), inherit(net, split_polygons(net), rules)


def _vertex_band(net, rules: Rules, own, ring, more=(), columns=None):
    """The rows of the old vertices: `own` share, and `ring` of every neighbor."""
    v, (a, b) = net.num_vertices, net.ends
    # The crease of a vertex reaches along its two sharp edges.
    share = ring[net.ends] + rules.along / 8
    each = np.arange(v, dtype=np.int32)
    parts = [(each, each, own), (a, b, share[0]), (b, a, share[1]), *more]
    entries = [np.concatenate(x) for x in zip(*parts, strict=True)]
    return band_from_entries(*entries, (v, columns or v))


def _middles(net):
    return even_band(net.ends, np.full(net.ends.shape, 0.5))


def _loop_edges(net, rules: Rules):
    opposite = net.corners[net.preceding]
    return _edge_band(net, rules, opposite, 3 / 8)


def _catmull_clark_edges(net, rules: Rules):
    return _edge_band(net, rules, net.num_vertices + net.face, 1 / 4)


def _edge_band(net, rules, across, near):
    """`near` of both ends and the rest of what lies across, faded to the middle."""
    e, (a, b) = net.ends.shape[1], net.ends
    # Of the sides of an edge the last one written stays: both orders give both sides.
    first, second = np.empty(e, np.int32), np.empty(e, np.int32)
    second[net.sides] = across
    first[net.sides[::-1]] = across[::-1]
    smooth = 1 - rules.edge
    sharp = smooth == 0
    far = smooth * (0.5 - near)
    close = smooth * near + 0.5 * rules.edge
    sides = [np.where(sharp, a, x) for x in (first, second)]
    return even_band(np.stack([a, b, *sides]), np.stack([close, close, far, far]))


def _with_centroids(net) -> Rows:
    v = net.num_vertices
    return Rows((identity_band(0, v), _centroids(net)), v)


def _centroids(net):
    """The mean of the corners of every face."""
    if net.is_uniform:
        corners = net.corners.reshape(-1, net.sizes[0]).T
        return even_band(corners, np.full(corners.shape, 1 / net.sizes[0]))
    face = net.face
    shape = (net.sizes.size, net.num_vertices)
    return band_from_entries(face, net.corners, 1 / net.sizes[face], shape)


def _check_triangles(net):
    if not np.all(net.sizes == 3):
        must = "Loop's scheme needs faces of three corners"
        fix = "Use mesh.triangulate(), or the scheme CatmullClark()."
        raise GeometryError(message(must, f"faces of {net.sizes.max()} corners", fix))
