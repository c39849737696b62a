"""`jaxgeom fuse SCAN SCAN ... -o MESH`."""

import json
import pathlib
import sys

import jax
import numpy as np

from .. import RESULTS, fuse
from ..io import load_cloud
from ._report import Stages, say
from ._surface import finish, settings


def run(arguments) -> int:
    """Align all scans, write poses and mesh, report."""
    stages = Stages()
    with stages.stage("read"):
        scans = [load_cloud(path) for path in arguments.inputs]
    with stages.stage("align and reconstruct"):
        out = fuse(
            scans,
            viewpoints=arguments.viewpoint,
            voxel_size=arguments.voxel_size,
            key=jax.random.key(arguments.seed),
            **settings(arguments),
        )
    aligned = bool(out.views.result == RESULTS.successful)
    if not aligned:
        print(f"jaxgeom: alignment: {RESULTS[out.views.result]}", file=sys.stderr)
    for note in out.notes[: len(out.notes) - len(out.reconstruction.notes)]:
        print(f"jaxgeom: note: {note}", file=sys.stderr)
    poses = [_matrix(out.world_from_scan, i).tolist() for i in range(len(scans))]
    if arguments.poses:
        named = dict(zip(arguments.inputs, poses, strict=True))
        text = json.dumps({"T_world_scan": named}, indent=2)
        pathlib.Path(arguments.poses).write_text(text + "\n")
    overlap = np.asarray(out.views.overlap).max(axis=1)
    for path, share in zip(arguments.inputs, overlap, strict=True):
        say(f"{path}: {100 * share:.0f} % of it lies on another scan")
    say(f"rms distance along the normals {float(out.views.rmse):.4g}")
    inputs = {
        "points": len(out.cloud.points),
        "paths": arguments.inputs,
        "T_world_scan": poses,
        "rmse": float(out.views.rmse),
    }
    return finish(arguments, out.reconstruction, stages, inputs, aligned)


def _matrix(poses, i):
    matrix = np.eye(4)
    matrix[:3, :3] = poses.rotation[i]
    matrix[:3, 3] = poses.translation[i]
    return matrix
