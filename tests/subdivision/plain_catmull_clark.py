"""Catmull-Clark with semi-sharp creases, vertex by vertex, as in the paper."""

import numpy as np


def level(points, faces, edge_sharpness, vertex_sharpness):
    """One level: points {name: place}, faces [names], sharpness {name or pair: s}.

    New vertices are named by the edge (a frozenset) or face (a tuple) they come from.
    """
    edges = {}
    for face in faces:
        for a, b in zip(face, face[1:] + face[:1], strict=True):
            edges.setdefault(frozenset((a, b)), []).append(face)
    sharp = {
        e: np.inf if len(f) == 1 else edge_sharpness.get(e, 0) for e, f in edges.items()
    }
    center = {face: np.mean([points[p] for p in face], axis=0) for face in faces}
    middle = {e: np.mean([points[p] for p in e], axis=0) for e in edges}
    new = dict(center)
    for edge, both in edges.items():
        share = min(sharp[edge], 1)
        smooth = (2 * middle[edge] + sum(center[f] for f in both)) / (2 + len(both))
        new[edge] = share * middle[edge] + (1 - share) * smooth
    for p in points:
        around = [e for e in edges if p in e]
        now = {e: sharp[e] for e in around}, vertex_sharpness.get(p, 0)
        later = {e: max(s - 1, 0) for e, s in now[0].items()}, max(now[1] - 1, 0)
        lost = [s for e, s in now[0].items() if s > 0 and later[0][e] == 0]
        lost += [now[1]] if now[1] > 0 and later[1] == 0 else []
        share = min(np.mean(lost), 1) if lost else 1
        args = points, p, around, middle, center, edges
        new[p] = share * _rule(*now, *args) + (1 - share) * _rule(*later, *args)
    halves = {
        frozenset((p, edge)): max(s - 1, 0) for edge, s in sharp.items() for p in edge
    }
    pins = {p: max(s - 1, 0) for p, s in vertex_sharpness.items()}
    return new, _quads(faces), {e: s for e, s in halves.items() if s > 0}, pins


def _rule(sharp, pin, points, p, around, middle, center, edges):
    creases = [e for e in around if sharp[e] > 0]
    if pin > 0 or len(creases) > 2:
        return points[p]
    if len(creases) == 2:
        ends = [points[q] for e in creases for q in e if q != p]
        return (6 * points[p] + ends[0] + ends[1]) / 8
    n = len(around)
    f = np.mean([center[f] for f in {f for e in around for f in edges[e]}], axis=0)
    r = np.mean([middle[e] for e in around], axis=0)
    return (f + 2 * r + (n - 3) * points[p]) / n


def _quads(faces):
    return [
        (
            p,
            frozenset((p, face[(i + 1) % len(face)])),
            face,
            frozenset((face[i - 1], p)),
        )
        for face in faces
        for i, p in enumerate(face)
    ]
