"""Winding numbers from multipoles of the nodes of a tree, exact nearby."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._groups import kd_groups
from ._packets import AbstractVisit, walk
from ._surface import SurfaceIndex

# Numbers of a child: center, far distance squared, moments of order 1, 2 and 3.
_PER_CHILD = 23
_PACKET = 16
_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_TRIPLES = tuple((i, j, k) for i in range(3) for j in range(i, 3) for k in range(j, 3))


class WindingVisit(AbstractVisit):
    """Adds the expansion of nodes that are far for all, the exact angles of leaves."""

    inner: Float[Array, "h 46"]
    leaves: Float[Array, "l w"]

    def wanted(self, row, query, state):
        """Children too near for their expansion."""
        one, two = (_near(row[i : i + _PER_CHILD], query) for i in (0, _PER_CHILD))
        return one, two, jnp.zeros_like(one)

    def passed(self, row, query, state, left, right):
        """The sum with the expansions of the children that all find far."""
        add = lambda gone, i: jnp.where(
            gone, _expansion(row[i : i + _PER_CHILD], query), 0
        )
        return state + add(left, 0) + add(right, _PER_CHILD)

    def taken(self, row, leaf, query, state):
        """The sum with the solid angles of the faces of a leaf."""
        for start in range(0, len(row), 9):
            state = state + _angle(row[start : start + 9], query)
        return state


# Outside jit, loops would compile what they close over as constants (slowly).
@jax.jit
def fast_winding(
    index: SurfaceIndex, points: Float[Array, "q 3"], beta: Float[Array, ""]
) -> Float[Array, " q"]:
    """The winding numbers at finite points, without derivative."""
    leaf = index.tree.leaf
    real = jnp.isfinite(index.packed)
    corners = jnp.where(real, index.packed, 0)
    leaves = corners.reshape(9, -1).T.reshape(-1, 9 * leaf)
    visit = WindingVisit(_moments(index.tree, corners, beta), leaves)
    groups = kd_groups(points, jnp.ones(points.shape[0], bool), _PACKET)
    total = walk(visit, points, groups, jnp.zeros(points.shape[0], points.dtype))
    return total / (4 * np.pi)


def _moments(tree, corners, beta):
    """The row of both children of every inner node; its first row is no node."""
    a, b, c = corners
    areas = jnp.cross(b - a, c - a, axis=0).T / 2
    points = jnp.moveaxis(corners, -1, 0)
    depth = tree.first_leaf.bit_length() - 1
    levels = [_level(tree, points, areas, 2 ** (i + 1), beta) for i in range(depth)]
    blank = jnp.zeros((1, 2 * _PER_CHILD), corners.dtype)
    rows = [level.reshape(-1, 2 * _PER_CHILD) for level in levels]
    return jnp.concatenate([blank, *rows])


def _level(tree, points, vectors, nodes, beta):
    """The numbers of all nodes of one level, [nodes, 23]."""
    group = lambda x: x.reshape(nodes, -1, *x.shape[1:])
    points, vectors = group(points), group(vectors)
    area = jnp.linalg.norm(vectors, axis=-1)
    middles = jnp.mean(points, axis=2)
    total = jnp.sum(area, axis=1)
    middle = jnp.einsum("ng,ngd->nd", area, middles)
    center = middle / jnp.where(total > 0, total, 1)[:, None]
    away = middles - center[:, None]
    around = points - middles[:, :, None]
    low, high = (x[:, nodes : 2 * nodes].T for x in (tree.low, tree.high))
    some = jnp.all(jnp.isfinite(low), axis=-1)
    reach = jnp.maximum(high - center, center - low)
    far = jnp.where(some, beta**2 * jnp.sum(reach**2, axis=-1), -1)
    first = jnp.sum(vectors, axis=1)
    second = jnp.einsum("ngi,ngj->nij", away, vectors)
    # The second moment of a triangle about its middle, per area.
    spread = jnp.einsum("ngci,ngcj->ngij", around, around) / 12
    spread = spread + away[..., :, None] * away[..., None, :]
    third = jnp.einsum("ngij,ngk->nijk", spread, vectors)
    third = (third + third.transpose(0, 2, 3, 1) + third.transpose(0, 3, 1, 2)) / 3
    pairs = [(second[:, i, j] + second[:, j, i]) / 2 for i, j in _PAIRS]
    triples = [third[:, i, j, k] for i, j, k in _TRIPLES]
    numbers = [center.T, far[None], first.T, jnp.stack(pairs), jnp.stack(triples)]
    return jnp.concatenate(numbers).T


def _near(child, point):
    gap = sum((child[d] - point[d]) ** 2 for d in range(3))
    return gap <= child[3]


def _expansion(child, point):
    """The sum of (x - q) . n / |x - q|^3 over a node, expanded about its center."""
    r = [child[d] - point[d] for d in range(3)]
    square = r[0] ** 2 + r[1] ** 2 + r[2] ** 2
    over = 1 / jnp.where(square > 0, square, jnp.inf)
    first, second, third = child[4:7], child[7:13], child[13:]
    one = sum(x * y for x, y in zip(first, r, strict=True))
    trace = second[0] + second[1] + second[2]
    twice = sum(
        (1 if i == j else 2) * m * r[i] * r[j]
        for m, (i, j) in zip(second, _PAIRS, strict=True)
    )
    thrice = sum(
        _orders(triple) * m * r[triple[0]] * r[triple[1]] * r[triple[2]]
        for m, triple in zip(third, _TRIPLES, strict=True)
    )
    at = dict(zip(_TRIPLES, third, strict=True))
    inner = sum(at[tuple(sorted((i, i, k)))] * r[k] for i in range(3) for k in range(3))
    order_2 = trace - 3 * over * twice
    order_3 = over * (-9 * inner + 15 * over * thrice) / 2
    return over * jnp.sqrt(over) * (one + order_2 + order_3)


def _orders(triple):
    """In how many orders the indices may stand."""
    return {1: 1, 2: 3, 3: 6}[len(set(triple))]


def _angle(face, point):
    """The solid angle of a face; zero for one without area."""
    a, b, c = ([face[3 * i + d] - point[d] for d in range(3)] for i in range(3))
    dot = lambda x, y: x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    la, lb, lc = (jnp.sqrt(dot(x, x)) for x in (a, b, c))
    volume = sum(
        a[i] * (b[(i + 1) % 3] * c[(i + 2) % 3] - b[(i + 2) % 3] * c[(i + 1) % 3])
        for i in range(3)
    )
    spread = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    # A padding face is one point: no angle, where spread may be negative by rounding.
    return jnp.where(volume == 0, 0, 2 * jnp.arctan2(volume, spread))
