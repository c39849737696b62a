"""Half-edges on the host: who lies opposite, and closed walks along the boundary.

Half-edge h = 3 * face + corner runs from that corner to the next one.
"""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def host_faces(mesh) -> np.ndarray:
    """The real faces of a mesh."""
    return np.asarray(mesh.faces)[: int(mesh.num_faces)]


def ends(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where every half-edge starts and where it ends."""
    return faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)


def edge_numbers(faces: np.ndarray) -> np.ndarray:
    """The number of the edge of every half-edge."""
    start, end = ends(faces)
    low, high = np.minimum(start, end), np.maximum(start, end)
    keys = low.astype(np.int64) * (int(faces.max(initial=0)) + 1) + high
    return np.unique(keys, return_inverse=True)[1].reshape(-1)


def partners(faces: np.ndarray) -> np.ndarray:
    """The half-edge on the other side of every half-edge; itself where there is none.

    Where more than two faces share an edge they are taken two by two, so that only an
    odd one is left over.
    """
    edge = edge_numbers(faces)
    order = np.argsort(edge, kind="stable")
    sorted_edge = edge[order]
    first = np.searchsorted(sorted_edge, sorted_edge, side="left")
    place = np.arange(len(order)) - first
    size = np.bincount(edge, minlength=1)[sorted_edge]
    second = place + np.where(place % 2 == 0, 1, -1)
    second = np.where(second < size, second, place)
    out = np.empty_like(order)
    out[order] = order[first + second]
    return out


def fan_labels(faces: np.ndarray) -> np.ndarray:
    """The number of the fan of every corner: corners of a vertex, joined by edges."""
    start, end = ends(faces)
    edge = edge_numbers(faces)
    h, e = len(start), int(edge.max(initial=-1)) + 1
    corner = np.arange(h)
    following = corner - corner % 3 + (corner + 1) % 3
    # The corners at the smaller end of an edge hang together, those at the larger too.
    rising = start < end
    low, high = np.where(rising, corner, following), np.where(rising, following, corner)
    rows = np.concatenate([low, high])
    columns = np.concatenate([h + edge, h + e + edge])
    size = h + 2 * e
    links = coo_array((np.ones(2 * h), (rows, columns)), shape=(size, size))
    return connected_components(links, directed=False)[1][:h]


def boundary_walks(faces: np.ndarray) -> list[np.ndarray]:
    """The closed walks of vertices along the boundary, in the direction of the faces.

    From every boundary edge the walk turns around its end vertex through the faces
    until the next boundary edge: loops that touch in a vertex stay apart. A face need
    not have the winding of its neighbor. Longest loop first.
    """
    if len(faces) == 0:
        return []
    start, end = ends(faces)
    partner = partners(faces)
    rim = np.flatnonzero(partner == np.arange(len(partner)))
    if len(rim) == 0:
        return []
    # Every boundary edge in both directions: a half-edge, and whether it is reversed.
    state = np.sort(np.concatenate([2 * rim, 2 * rim + 1]))
    following = np.searchsorted(state, _next_on_rim(faces, partner, state))
    label, place = _cycles(following)
    halfedge, reverse = state // 2, state % 2
    origin = np.where(reverse == 1, end[halfedge], start[halfedge])
    return _chosen_cycles(label, place, origin, halfedge, reverse)


def _next_on_rim(faces, partner, state):
    """The next directed boundary edge after each one."""
    start, end = ends(faces)
    halfedge, reverse = state // 2, state % 2
    pivot = np.where(reverse == 1, start[halfedge], end[halfedge])
    moving = np.ones(len(state), bool)
    here = halfedge.copy()
    while np.any(moving):
        # The other side of the face at the pivot.
        face, side = here // 3, here % 3
        after, before = 3 * face + (side + 1) % 3, 3 * face + (side + 2) % 3
        at_pivot = (start[after] == pivot) | (end[after] == pivot)
        other = np.where(at_pivot, after, before)
        here = np.where(moving, other, here)
        moving &= partner[here] != here
        here = np.where(moving, partner[here], here)
    return 2 * here + (start[here] != pivot)


def _cycles(following):
    """Of every element of a permutation: the least one of its cycle, steps from it."""
    n = len(following)
    label, jump = np.arange(n), following.copy()
    for _ in range(max(n, 2).bit_length()):
        label = np.minimum(label, label[jump])
        jump = jump[jump]
    root = label == np.arange(n)
    steps = np.where(root, 0, 1)
    jump = np.where(root, np.arange(n), following)
    for _ in range(max(n, 2).bit_length()):
        steps = steps + steps[jump]
        jump = jump[jump]
    size = np.bincount(label, minlength=n)[label]
    return label, np.where(root, 0, size - steps)


def _chosen_cycles(label, place, origin, halfedge, reverse):
    """One of the two directions of every loop: that of most of its faces."""
    order = np.lexsort((place, label))
    cuts = np.flatnonzero(np.diff(label[order])) + 1
    loops = np.split(order, cuts)
    best = {}
    for loop in loops:
        name, backward = halfedge[loop].min(), reverse[loop].mean()
        if name not in best or backward < best[name][0]:
            best[name] = (backward, origin[loop])
    return sorted((walk for _, walk in best.values()), key=len, reverse=True)
