"""The flattening of a disc onto the unit square, without folds.

Every inner vertex is a mean of its neighbors with positive weights (mean value
coordinates), the boundary a convex curve: no triangle turns over (Tutte).

    w_ij = (tan(a / 2) + tan(b / 2)) / |x_i - x_j|,

a and b the angles at x_i on both sides of the edge.
"""

import numpy as np
from jaxtyping import Float
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import spsolve

from .._core import GeometryError, message
from ..shapes import TriangleMesh
from ._report import report

_CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def disc_parameters(mesh: TriangleMesh) -> Float[np.ndarray, "v 2"]:
    """The place of every vertex in the unit square, which a disc covers once (host).

    The boundary goes around the square counter-clockwise, seen from outside, in
    proportion to its length, a quarter of it to each side; of all such ways the one
    with the sharpest turns of the boundary at the corners is taken. Inside, the map is
    close to one that keeps angles. A triangle with all its corners on one side of the
    square has no area there. Sizes are exact: the padding is cut off, as by `trim`.

    Raises `GeometryError` for what is no disc: one component, manifold and oriented,
    with one boundary loop and no handle, faces of positive area, and a face at every
    vertex.

    Source: M. S. Floater, Mean value coordinates, 2003.
    """
    mesh = mesh.trim()
    found = report(mesh)
    _check(found)
    points, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    (loop,) = found.boundary_loops
    uv = np.zeros((len(points), 2))
    uv[loop] = _around_square(points[loop])
    inner = np.ones(len(points), bool)
    inner[loop] = False
    if inner.any():
        rows = _mean_value_weights(points, faces)[inner]
        share = rows.multiply(1 / rows.sum(axis=1)[:, None]).tocsr()
        system = eye_array(inner.sum(), format="csc") - share[:, inner].tocsc()
        uv[inner] = spsolve(system, share[:, ~inner] @ uv[~inner])
    return uv


def _check(found):
    counts = {
        "components": found.num_components,
        "boundary loops": len(found.boundary_loops),
        "Euler characteristic": found.euler,
    }
    wrong = [f"{name} {n}" for name, n in counts.items() if n != 1]
    wrong += [
        f"{len(getattr(found, name))} {name.replace('_', ' ')}"
        for name in (
            "nonmanifold_edges",
            "nonmanifold_vertices",
            "inconsistent_edges",
            "degenerate_faces",
            "unreferenced_vertices",
            "nonfinite_vertices",
        )
        if len(getattr(found, name))
    ]
    if wrong:
        raise GeometryError(
            message(
                "the mesh must be a disc: one clean component with one boundary loop "
                "and Euler characteristic 1",
                ", ".join(wrong),
                "Cut it open along edges, fill other holes, or see meshes.report.",
            )
        )


def _around_square(points):
    """The places of a closed walk [n, 3] on the sides of the unit square."""
    ahead = np.roll(points, -1, axis=0) - points
    length = np.linalg.norm(ahead, axis=1)
    along = np.concatenate([[0], np.cumsum(length)[:-1]]) / length.sum()
    way = ahead / length[:, None]
    turn = np.arccos(np.clip(np.sum(way * np.roll(way, 1, axis=0), axis=1), -1, 1))
    # For every start, the vertices nearest to the four quarters.
    quarters = (along[:, None] + np.arange(4) / 4) % 1
    after = np.searchsorted(along, quarters) % len(along)
    before = (after - 1) % len(along)
    gap = lambda i: np.abs((along[i] - quarters + 0.5) % 1 - 0.5)
    corners = np.where(gap(after) <= gap(before), after, before)
    sharp = turn[corners].sum(axis=1)
    # Four corners must be four vertices, in order; a walk of three has none such.
    apart = (np.diff(np.sort(corners, axis=1), axis=1) > 0).all(axis=1)
    chosen = corners[np.argmax(np.where(apart, sharp, sharp - 100))]
    knots = np.sort(chosen) if apart.any() else np.arange(4) * len(along) // 4
    place = along - along[knots[0]]
    stops = np.append(place[knots], 1.0)
    quarter = np.interp(place % 1, stops, np.arange(5))
    side = np.minimum(quarter.astype(int), 3)
    share = (quarter - side)[:, None]
    return (1 - share) * _CORNERS[side] + share * _CORNERS[(side + 1) % 4]


def _mean_value_weights(points, faces):
    """The weights w_ij [v, v], of which those of inner vertices are whole."""
    rows, columns, weights = [], [], []
    for corner in range(3):
        i, j, k = (faces[:, (corner + step) % 3] for step in range(3))
        to_j, to_k = points[j] - points[i], points[k] - points[i]
        far_j, far_k = (np.linalg.norm(x, axis=1) for x in (to_j, to_k))
        # tan(a / 2) = sin a / (1 + cos a).
        sine = np.linalg.norm(np.cross(to_j, to_k), axis=1)
        half = sine / (far_j * far_k + np.sum(to_j * to_k, axis=1))
        rows += [i, i]
        columns += [j, k]
        weights += [half / far_j, half / far_k]
    pairs = (np.concatenate(rows), np.concatenate(columns))
    size = (len(points),) * 2
    return coo_array((np.concatenate(weights), pairs), shape=size).tocsr()
