"""The corners around every vertex, in order, from crease to crease (host)."""

import equinox as eqx
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from .._core import GeometryError, message
from ._net import Net


class Sectors(eqx.Module):
    """The corners at each vertex, split where infinitely sharp edges leave it.

    - `sector` [h], `place` [h]: the sector of each corner and its number in it,
      counter-clockwise seen from outside.
    - Of each sector [s]: `vertex`; `size`, its corners; `closed`, it runs all around
      with no sharp edge; `last`, its last corner.
    """

    sector: np.ndarray
    place: np.ndarray
    vertex: np.ndarray
    size: np.ndarray
    closed: np.ndarray
    last: np.ndarray


def sectors_of(net: Net) -> Sectors:
    """The sectors of all vertices, in the order of their vertices.

    Raises `GeometryError` where the two faces of an edge run through it in the same
    direction: there is no outside.
    """
    h = net.corners.size
    sharp = np.isinf(net.sharpness)
    onward, linked = _rotation(net, sharp)
    here = np.arange(h)
    pairs = (np.ones(linked.sum()), (here[linked], onward[linked]))
    count, label = connected_components(coo_matrix(pairs, shape=(h, h)), directed=False)
    # A sector begins at its sharp edge; where there is none, at its first corner.
    opens = sharp[net.sides]
    rank = np.where(opens, here, here + h)
    start = np.full(count, 2 * h)
    np.minimum.at(start, label, rank)
    closed, start = start >= h, start % h
    order = np.lexsort((start, net.corners[start]))
    number = np.empty(count, int)
    number[order] = np.arange(count)
    label, start, closed = number[label], start[order], closed[order]
    size = np.bincount(label, minlength=count)
    place, last = _walk(start, size, onward)
    return Sectors(label, place, net.corners[start], size, closed, last)


def _rotation(net, sharp):
    """The next corner around the vertex of each, and whether no crease lies between."""
    before = net.preceding
    start, end = net.corners, net.corners[net.following]
    forward = net.ends[0][net.sides] == start
    slots = np.full((2, net.ends.shape[1]), start.size)
    slots[np.where(forward, 0, 1), net.sides] = np.arange(start.size)
    used = np.bincount(2 * net.sides + forward, minlength=2 * net.ends.shape[1])
    if used.max() > 1:
        h = int(np.flatnonzero(used[2 * net.sides + forward] > 1)[0])
        must = "the two faces of an edge must run through it in opposite directions"
        given = f"both run from {start[h]} to {end[h]}"
        fix = "Orient the faces consistently; normals need an outside."
        raise GeometryError(message(must, given, fix))
    opposite = slots[np.where(forward, 1, 0), net.sides]
    onward = opposite[before]
    linked = (onward < start.size) & ~sharp[net.sides[before]]
    return np.where(onward < start.size, onward, 0), linked


def _walk(start, size, onward):
    """The place of every corner in its sector, and the last corner of each sector."""
    place, last = np.zeros(onward.size, int), start.copy()
    here, alive = start, np.arange(start.size)
    for step in range(int(size.max())):
        place[here] = step
        last[alive] = here
        more = size[alive] > step + 1
        here, alive = onward[here[more]], alive[more]
    return place, last
