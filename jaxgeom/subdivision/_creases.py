"""Sharp edges and vertices, how they decay, and the rules they impose on vertices."""

import abc

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int

from .._core import GeometryError, check_shape, message
from ._net import Net


class Creases(eqx.Module):
    """Sharp edges and vertices of a mesh, made and used on the host.

    An edge of sharpness s is subdivided like a border for s levels and smoothly from
    then on; for fractions the two rules are blended (DeRose, Kass, Truong 1998). The
    border of a mesh is infinitely sharp by itself.

    **Arguments:**

    - `edges`: integer [c, 2], the ends of each edge in any order; `sharpness`: [c] or
      one number, 0 for smooth, infinite for a crease that stays.
    - `vertices`: integer [p]; `vertex_sharpness`: [p] or one number: these vertices
      stay where they are for so many levels.

    Raises `GeometryError` for shapes that do not agree and for negative or undefined
    sharpness.

    >>> Creases([(0, 1), (1, 2)], 2.5).sharpness.tolist()
    [2.5, 2.5]
    """

    edges: Int[Array, "c 2"]
    sharpness: Float[Array, " c"]
    vertices: Int[Array, " p"]
    vertex_sharpness: Float[Array, " p"]

    def __init__(
        self, edges=(), sharpness=np.inf, vertices=(), vertex_sharpness=np.inf
    ):
        self.edges = np.asarray(edges, np.int32).reshape(np.shape(edges) or (0, 2))
        if not self.edges.size:
            self.edges = np.zeros((0, 2), np.int32)
        self.vertices = np.asarray(vertices, np.int32)
        check_shape("edges", self.edges, (None, 2))
        check_shape("vertices", self.vertices, (None,))
        self.sharpness = _spread("sharpness", sharpness, len(self.edges))
        self.vertex_sharpness = _spread(
            "vertex_sharpness", vertex_sharpness, len(self.vertices)
        )


class AbstractDecay(eqx.Module):
    """How the sharpness of an edge passes to its two halves."""

    @abc.abstractmethod
    def __call__(self, net: Net) -> Float[Array, "2 e"]:
        """The sharpness of the half of each edge at each of its ends."""


class UniformDecay(AbstractDecay):
    """Both halves get the sharpness less one: max(s - 1, 0)."""

    def __call__(self, net):
        """The sharpness of the half of each edge at each of its ends [2, e]."""
        return _less_one(np.stack([net.sharpness] * 2))


class ChaikinDecay(AbstractDecay):
    """Sharpness that varies along a crease is smoothed as it decays.

    The half at a vertex gets max((3 s + t) / 4 - 1, 0), t being the mean sharpness of
    the other semi-sharp edges there; without any, max(s - 1, 0). Infinite sharpness
    stays and is not mixed in (DeRose, Kass, Truong 1998, 4.3).
    """

    def __call__(self, net):
        """The sharpness of the half of each edge at each of its ends [2, e]."""
        s = net.sharpness
        soft = (s > 0) & np.isfinite(s)
        own = np.where(soft, s, 0.0)
        total = _at_ends(net, np.stack([own] * 2))[net.ends]
        others = _at_ends(net, np.stack([soft] * 2))[net.ends] - soft
        mean = (total - own) / np.maximum(others, 1)
        mixed = np.where(soft & (others > 0), 0.75 * s + 0.25 * mean, s)
        return _less_one(mixed)


class Rules(eqx.Module):
    """What becomes of the old vertices, as shares of three rules that add up to one.

    - `smooth` [v]; `crease` [v]: 3/4 of itself and 1/8 of both neighbors along the
      crease; `fixed` [v].
    - `along` [2, e]: how much each edge is the crease of its end, for the 1/8.
    - `edge` [e]: how much the middle of each edge is sharp.
    - `halves` [2, e], `pins` [v]: the sharpness of the next level.
    """

    smooth: np.ndarray
    crease: np.ndarray
    fixed: np.ndarray
    along: np.ndarray
    edge: np.ndarray
    halves: np.ndarray
    pins: np.ndarray


def rules_of(net: Net, decay: AbstractDecay) -> Rules:
    """The rule of each vertex now, faded to that of the next level.

    A vertex is fixed while it is sharp, or has three or more sharp edges, or no edge;
    a crease where it has two; smooth otherwise. Where edges cease to be sharp at this
    level, the mean of their sharpness (below one) is the share of the rule now, the
    rest is that of the rule without them (Pixar OpenSubdiv, Sdc, scheme.h).
    """
    halves, pins = decay(net), _less_one(net.pins)
    now = np.stack([net.sharpness > 0] * 2)
    later = halves > 0
    lost, unpinned = now & ~later, (net.pins > 0) & (pins == 0)
    number = _at_ends(net, lost) + unpinned
    amount = np.where(lost, net.sharpness, 0.0)
    total = _at_ends(net, amount) + np.where(unpinned, net.pins, 0.0)
    share = np.where(number > 0, np.minimum(total / np.maximum(number, 1), 1), 1.0)
    bare = net.valence == 0
    first = _shares(net, now, (net.pins > 0) | bare, share)
    second = _shares(net, later, (pins > 0) | bare, 1 - share)
    mixed = [a + b for a, b in zip(first, second, strict=True)]
    return Rules(*mixed, np.minimum(net.sharpness, 1.0), halves, pins)


def with_creases(net: Net, creases: Creases | None) -> Net:
    """The net with the sharpness of some edges and vertices.

    Raises `GeometryError` for edges and vertices that the mesh does not have.
    """
    if creases is None:
        return net
    v = net.num_vertices
    _check_inside("vertices", creases.vertices, v)
    _check_inside("edges", creases.edges, v)
    key = lambda a, b: np.minimum(a, b) * np.int64(v) + np.maximum(a, b)
    known, wanted = key(*net.ends), key(*creases.edges.T)
    order = np.argsort(known)
    place = order[np.minimum(np.searchsorted(known[order], wanted), known.size - 1)]
    missing = np.flatnonzero(known[place] != wanted)
    if missing.size:
        a, b = creases.edges[missing[0]].tolist()
        given = f"{missing.size} that are not, first ({a}, {b})"
        fix = "Name edges by the two vertices of one side of a face."
        raise GeometryError(message("creases must be edges of the mesh", given, fix))
    sharpness, pins = net.sharpness.copy(), net.pins.copy()
    np.maximum.at(sharpness, place, creases.sharpness)
    np.maximum.at(pins, creases.vertices, creases.vertex_sharpness)
    return eqx.tree_at(lambda n: (n.sharpness, n.pins), net, (sharpness, pins))


def inherit(net: Net, child: Net, rules: Rules) -> Net:
    """The child with what is left of its parent's sharpness."""
    e, v = net.ends.shape[1], net.num_vertices
    sharpness, pins = child.sharpness.copy(), child.pins.copy()
    sharpness[: 2 * e] = rules.halves.ravel()
    pins[:v] = rules.pins
    return eqx.tree_at(lambda n: (n.sharpness, n.pins), child, (sharpness, pins))


def creases_of(net: Net) -> Creases:
    """What is sharp in a net, without its border."""
    sharp = (net.sharpness > 0) & ~net.border
    pinned = np.flatnonzero(net.pins)
    edges = net.ends[:, sharp].T
    return Creases(edges, net.sharpness[sharp], pinned, net.pins[pinned])


def _shares(net, sharp, pinned, weight):
    """The shares of the three rules and of the crease edges, times `weight` [v]."""
    number = _at_ends(net, sharp)
    fixed = pinned | (number > 2)
    crease = ~fixed & (number == 2)
    parts = ~fixed & ~crease, crease, fixed
    along = sharp * (crease * weight)[net.ends]
    return *(weight * part for part in parts), along


def _at_ends(net, values):
    """The sum over the edges of each vertex of a value [2, e] at their ends."""
    weights = np.asarray(values, float).ravel()
    return np.bincount(net.ends.ravel(), weights, minlength=net.num_vertices)


def _less_one(s):
    return np.maximum(s - 1, 0)


def _spread(name, value, count):
    value = np.asarray(value, float)
    value = np.full(count, value) if value.ndim == 0 else value
    check_shape(name, value, (count,))
    if not np.all(value >= 0):
        worst = value[~(value >= 0)][0]
        fix = "Use 0 for smooth, numpy.inf for a crease that stays."
        raise GeometryError(message(f"{name} must be at least 0", f"{worst}", fix))
    return value


def _check_inside(name, indices, v):
    if indices.size and (indices.min() < 0 or indices.max() >= v):
        must = f"{name} of creases must be vertices 0 ... {v - 1}"
        given = f"indices from {indices.min()} to {indices.max()}"
        raise GeometryError(message(must, given, "Name vertices of the mesh."))
