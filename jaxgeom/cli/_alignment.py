"""What the commands that align scans share: their settings, and what they tell."""

import dataclasses

import numpy as np

from .. import RESULTS, Pyramid
from ..pipelines import choose_voxel_size
from ..registration import (
    L2,
    Cauchy,
    GemanMcClure,
    Generalized,
    Huber,
    Method,
    PointToPlane,
    PointToPoint,
    RigidModel,
    SimilarityModel,
    Symmetric,
    Tukey,
    Welsch,
)

_OBJECTIVES = {
    "point-to-point": PointToPoint,
    "point-to-plane": PointToPlane,
    "symmetric": Symmetric,
    "generalized": Generalized,
}
_KERNELS = {
    "l2": L2,
    "huber": Huber,
    "cauchy": Cauchy,
    "geman-mcclure": GemanMcClure,
    "tukey": Tukey,
    "welsch": Welsch,
}


def settings(arguments, target) -> dict:
    """The keyword arguments of `register`."""
    model = SimilarityModel() if arguments.with_scale else RigidModel()
    method = Method(
        objective=_OBJECTIVES[arguments.objective](),
        kernel=_KERNELS[arguments.kernel](),
        model=model,
    )
    pyramid = dataclasses.replace(Pyramid(), method=method)
    size = arguments.voxel_size
    points = np.asarray(target.points, np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    farthest = arguments.max_correspondence_distance
    if farthest is not None and len(points):
        if farthest < 0:
            farthest = -farthest * np.linalg.norm(np.ptp(points, axis=0))
        size = choose_voxel_size(points) if size is None else size
        last = float(farthest / size)
        gates = tuple(max(gate, last) for gate in pyramid.gates[:-1])
        pyramid = dataclasses.replace(pyramid, gates=(*gates, last))
    return {"voxel_size": size, "pyramid": pyramid}


def sound(found) -> bool:
    """Whether the alignment passes its own check."""
    return bool(found.result == RESULTS.successful)


def facts(found) -> dict:
    """The result of one alignment as plain numbers."""
    matrix = np.asarray(found.target_from_source.matrix(), np.float64)
    return {
        "status": "ok" if sound(found) else RESULTS[found.result],
        "T_target_source": matrix.tolist(),
        "rmse": float(found.rmse),
        "fitness": float(found.fitness),
        "num_matches": int(found.num_matches),
        "num_steps": int(found.num_steps),
        "information": np.asarray(found.information, np.float64).tolist(),
    }


def matrix_lines(transform) -> list[str]:
    """The rows of the 4 x 4 matrix, in full precision."""
    matrix = np.asarray(transform.matrix(), np.float64)
    return [" ".join(f"{x: .15g}" for x in row) for row in matrix]
