"""Which face is nearest: the visit of a tree of faces by packets of queries."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ._packets import AbstractVisit

# Numbers per face in a row of a leaf.
_PER_FACE = 15


class ClosestVisit(AbstractVisit):
    """Keeps the least squared distance so far, and the leaf where it was found.

    The state is (best, seen, leaf, last): `best` has already taken in leaf `last`, and
    `seen` is what it was before; the leaf is noted one visit late, from values that are
    in memory by then, or XLA would compute all distances once more for it.
    """

    inner: Float[Array, "h 12"]
    leaves: Float[Array, "l w"]

    def wanted(self, row, query, state):
        """Children that are nearer than the best so far."""
        best = state[0]
        left = _box_square(row[0:3], row[3:6], query)
        right = _box_square(row[6:9], row[9:12], query)
        one, two = left < best, right < best
        return one, two, (one | two) & (right < left)

    def taken(self, row, leaf, query, state):
        """The least distance after the faces of a leaf."""
        best, seen, found, last = state
        found = jnp.where(best < seen, last, found)
        new = best
        for start in range(0, len(row), _PER_FACE):
            new = _lesser(_square(row[start : start + _PER_FACE], query), new)
        return new, best, found, jnp.broadcast_to(leaf, found.shape)

    @staticmethod
    def start(live, none: int):
        """The state of queries before the walk; those not `live` want nothing."""
        best = jnp.where(live, jnp.inf, -1)
        blank = jnp.full(live.shape, none, jnp.int32)
        return best, best, blank, blank

    @staticmethod
    def leaf(state):
        """The leaf where the least distance was found."""
        best, seen, found, last = state
        return jnp.where(best < seen, last, found)


def face_rows(packed: Float[Array, "3 3 m"], leaf: int) -> Float[Array, "l w"]:
    """A row of numbers for every leaf: what `_square` needs of each of its faces."""
    a, b, c = packed
    real = jnp.isfinite(a[0])
    ab, ac = jnp.where(real, b - a, 0), jnp.where(real, c - a, 0)
    bc = ac - ab
    dot = lambda x, y: jnp.sum(x * y, axis=0)
    bb, cc, mixed = dot(ab, ab), dot(ac, ac), dot(ab, ac)
    area = bb * cc - mixed * mixed
    # A sliver has no plane in this precision: its edges hold the closest point.
    solid = area > 8 * jnp.finfo(area.dtype).eps * bb * cc
    over = lambda x, y, some: jnp.where(some, x, 0) / jnp.where(some, y, 1)
    edges = [over(1, square, square > 0) for square in (bb, cc, dot(bc, bc))]
    plane = [over(x, area, solid) for x in (cc, bb, mixed)]
    rows = jnp.concatenate([a, ab, ac, jnp.stack(edges + plane)])
    return rows.T.reshape(-1, leaf * _PER_FACE)


def _square(face: list, point: list):
    """The squared distance of points to a face, infinite for padding.

    The least over the closest points of the three edges and, where it lies within, the
    foot in the plane: each is the distance to a point of the face, so that rounding
    can make it too large only.
    """
    a, ab, ac = face[0:3], face[3:6], face[6:9]
    over_bb, over_cc, over_ee, plane_cc, plane_bb, plane_bc = face[9:]
    bc = [y - x for x, y in zip(ab, ac, strict=True)]
    ap = [x - y for x, y in zip(point, a, strict=True)]
    bp = [x - y for x, y in zip(ap, ab, strict=True)]
    along_ab, along_ac = _dot(ap, ab), _dot(ap, ac)
    ab_share = _unit(along_ab * over_bb)
    ac_share = _unit(along_ac * over_cc)
    bc_share = _unit(_dot(bp, bc) * over_ee)
    b_share = plane_cc * along_ab - plane_bc * along_ac
    c_share = plane_bb * along_ac - plane_bc * along_ab
    within = (b_share > 0) & (c_share > 0) & (b_share + c_share < 1)
    edges = _lesser(
        _lesser(_gap(ap, ab, ab_share), _gap(ap, ac, ac_share)), _gap(bp, bc, bc_share)
    )
    inner = sum(
        (p - b_share * x - c_share * y) ** 2 for p, x, y in zip(ap, ab, ac, strict=True)
    )
    return jnp.where(within, inner, edges)


def _box_square(low, high, point):
    """The squared distance to a box."""
    gap = lambda d: _positive(_greater(low[d] - point[d], point[d] - high[d]))
    return sum(gap(d) ** 2 for d in range(3))


def _gap(away, edge, share):
    return sum((p - share * x) ** 2 for p, x in zip(away, edge, strict=True))


def _dot(x, y):
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


# Comparisons and selections: the minima of XLA take care of NaN, which costs twice.
def _lesser(x, y):
    return jnp.where(x < y, x, y)


def _greater(x, y):
    return jnp.where(x > y, x, y)


def _positive(x):
    return jnp.where(x > 0, x, 0)


def _unit(x):
    return jnp.where(x > 0, jnp.where(x < 1, x, 1), 0)
