"""The rows of limit positions and tangents, from masks and sectors (host)."""

import equinox as eqx
import numpy as np

from ._masks import AbstractMasks, dart_masks
from ._net import Net
from ._operator import Band, band_from_entries
from ._rings import Sectors


class Neighborhoods(eqx.Module):
    """Sectors with their neighbors and the rule of their vertices.

    - `sharp` [v]: the number of infinitely sharp edges; `fixed` [v].
    - `sector`, `place`, `beside`, `facing` [h]: of each corner its sector, its number i
      in it, and Q_i and F_i; `size` [h]: the faces of its sector.
    - `ring`, `dart`, `crease`, `corner` [s]: the kind of each sector; `far` [s]: the
      neighbor Q_k that ends it.
    """

    sharp: np.ndarray
    fixed: np.ndarray
    sector: np.ndarray
    place: np.ndarray
    beside: np.ndarray
    facing: np.ndarray
    size: np.ndarray
    ring: np.ndarray
    dart: np.ndarray
    crease: np.ndarray
    corner: np.ndarray
    far: np.ndarray


def neighborhoods(net: Net, around: Sectors) -> Neighborhoods:
    """Which mask holds for each sector, and which vertices it reaches."""
    ends = net.ends[:, np.isinf(net.sharpness)]
    sharp = np.bincount(ends.ravel(), minlength=net.num_vertices)
    fixed = np.isinf(net.pins) | (sharp > 2) | (net.valence == 0)
    number, still = sharp[around.vertex], fixed[around.vertex]
    single = ~around.closed & (number == 1)
    several = ~around.closed & (number > 1)
    following = net.following
    return Neighborhoods(
        sharp=sharp,
        fixed=fixed,
        sector=around.sector,
        place=around.place,
        beside=net.corners[following],
        facing=net.corners[following[following]],
        size=around.size[around.sector],
        ring=around.closed | (single & still),
        dart=single & ~still,
        crease=several & ~still,
        corner=several & still,
        far=net.corners[net.preceding[around.last]],
    )


def position_band(net: Net, near: Neighborhoods, masks: AbstractMasks, v: int) -> Band:
    """The limits of the first `v` vertices."""
    smooth = ~near.fixed & (near.sharp == 0)
    crease = ~near.fixed & (near.sharp == 2)
    n = np.maximum(net.valence, 1)
    own, edge, face = (np.where(smooth, w, 0) for w in masks.smooth(n))
    own = own + near.fixed + crease * (2 / 3)
    at = net.corners
    beside, facing = edge[at], face[at]
    for rows, mask in _darts(near, masks):
        k = near.size[rows]
        first = rows[near.place[rows] == 0]
        own[at[first]] = mask[0][0]
        beside[rows] = mask[0][1 + near.place[rows]]
        facing[rows] = _faces(mask[0], k, near.place[rows])
    sharp = np.isinf(net.sharpness) / 6
    a, b = net.ends
    terms = [
        (np.arange(net.num_vertices), np.arange(net.num_vertices), own),
        (a, b, sharp * crease[a]),
        (b, a, sharp * crease[b]),
        (at, near.beside, beside),
        (at, near.facing, facing),
    ]
    return _band(terms, v, net.num_vertices)


def tangent_bands(
    net: Net, around: Sectors, near: Neighborhoods, masks: AbstractMasks, count: int
) -> tuple[Band, Band]:
    """Both tangents of the first `count` sectors."""
    along = _along(near, masks)
    away = _away(near, masks)
    sectors = np.arange(around.vertex.size)
    band = lambda own, end, beside, facing: _band(
        [
            (sectors, around.vertex, own),
            (sectors, near.far, end),
            (near.sector, near.beside, beside),
            (near.sector, near.facing, facing),
        ],
        count,
        net.num_vertices,
    )
    return band(*along), band(*away)


def _along(near: Neighborhoods, masks):
    """The weights of P, Q_k [s] and Q_i, F_i [h] in the tangent toward Q_0."""
    beside, facing = _turning(near, masks, np.cos)
    own = np.where(near.corner, -1.0, 0.0)
    end = np.where(near.crease, -1.0, 0.0)
    sharp = (near.crease | near.corner)[near.sector]
    beside = np.where(sharp, near.place == 0, beside)
    for rows, mask in _darts(near, masks):
        place = near.place[rows]
        own[near.sector[rows]] = mask[1][0]
        beside[rows] = mask[1][1 + place]
        facing[rows] = _faces(mask[1], near.size[rows], place)
    return own, end, beside, facing


def _away(near: Neighborhoods, masks):
    """The same in the tangent a quarter turn further, or away from the crease."""
    beside, facing = _turning(near, masks, np.sin)
    crease = near.crease[near.sector]
    own_h, end_h, inner, face = masks.across(near.size, near.place)
    beside = np.where(crease, np.where(near.place == 0, end_h, inner), beside)
    facing = np.where(crease, face, facing)
    own, end = np.where(near.corner, -1.0, 0.0), np.where(near.corner, 1.0, 0.0)
    heads = np.flatnonzero(crease & (near.place == 0))
    own[near.sector[heads]] = own_h[heads]
    end[near.sector[heads]] = end_h[heads]
    return own, end, beside, facing


def _turning(near: Neighborhoods, masks, wave):
    """The weights of smooth rings; zero for sectors between sharp edges."""
    k, i = near.size, near.place
    turn = lambda j: wave(2 * np.pi * j / k)
    whole = (near.ring | near.dart)[near.sector]
    facing = turn(i) + turn(i + 1) if masks.has_faces else np.zeros(k.shape)
    return np.where(whole, masks.ring(k) * turn(i), 0), np.where(whole, facing, 0)


def _darts(near: Neighborhoods, masks):
    """For each number of faces around the end of a crease, those corners and masks."""
    at = near.dart[near.sector]
    for n in np.unique(near.size[at]):
        yield np.flatnonzero(at & (near.size == n)), dart_masks(masks, int(n))


def _faces(mask, k, place):
    """The weights of F_i, which come after those of P and Q, if there are any."""
    full = np.concatenate([mask, np.zeros(2 * k.max() + 1 - len(mask))])
    return full[1 + k + place]


def _band(terms, rows, columns):
    entries = [np.concatenate(x) for x in zip(*terms, strict=True)]
    kept = entries[0] < rows
    return band_from_entries(*(x[kept] for x in entries), (rows, columns))
