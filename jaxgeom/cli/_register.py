"""`jaxgeom register SOURCE TARGET`."""

import dataclasses
import sys

import jax
import numpy as np

from .. import MeanAligned, Rigid, find_start, register
from .._core import GeometryError, message
from ..io import load_cloud, save_cloud
from ._alignment import facts, matrix_lines, settings, sound
from ._main import CHECK, OK
from ._report import Stages, say, write_report


def run(arguments) -> int:
    """Align, print T_target_source, write the moved scan and the report."""
    stages = Stages()
    with stages.stage("read"):
        source, target = (load_cloud(p) for p in (arguments.source, arguments.target))
    with stages.stage("align"):
        init = _start(arguments, source, target)
        chosen = settings(arguments, target)
        found = register(source, target, init=init, throw=False, **chosen)
    good = sound(found)
    if arguments.output and good:
        with stages.stage("write"):
            save_cloud(arguments.output, _moved(source, found.target_from_source))
    if arguments.report:
        write_report(
            arguments.report,
            parameters=vars(arguments),
            result=facts(found),
            seconds=stages.seconds,
        )
    say("T_target_source")
    for line in matrix_lines(found.target_from_source):
        say(line)
    told = facts(found)
    say(
        f"rmse {told['rmse']:.4g}, fitness {told['fitness']:.3f}, "
        f"{told['num_matches']} pairs, {told['num_steps']} steps"
    )
    if not good:
        print(f"jaxgeom: alignment: {told['status']}", file=sys.stderr)
    return OK if good else CHECK


def _start(arguments, source, target):
    if arguments.mean:
        return MeanAligned()
    if arguments.init:
        return _read_matrix(arguments.init)
    if not arguments.find_start:
        return None
    key = jax.random.key(arguments.seed)
    return find_start(source, target, key=key).target_from_source


def _read_matrix(path) -> Rigid:
    """The rigid motion of a text file with four rows of four numbers."""
    try:
        matrix = np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise _bad_matrix(path, str(error)) from None
    if matrix.shape != (4, 4):
        raise _bad_matrix(path, f"shape {matrix.shape}")
    turn = matrix[:3, :3]
    off = np.abs(turn @ turn.T - np.eye(3)).max()
    if off > 1e-3 or np.linalg.det(turn) < 0:
        raise _bad_matrix(path, f"a linear part that is no rotation (off by {off:.2g})")
    return Rigid(turn, matrix[:3, 3])


def _bad_matrix(path, given):
    must = f"{path} must hold a rigid motion as a 4 x 4 matrix"
    return GeometryError(message(must, given, "Write four rows of four numbers."))


def _moved(cloud, transform):
    """The cloud moved in double precision, with all that it carries."""
    matrix = np.asarray(transform.matrix(), np.float64)
    points = np.asarray(cloud.points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    points = points.astype(cloud.points.dtype)
    normals = cloud.normals
    if normals is not None:
        turned = np.asarray(normals) @ np.linalg.inv(matrix[:3, :3])
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        normals = turned / np.where(length > 0, length, 1)
    return dataclasses.replace(cloud, points=points, normals=normals)
