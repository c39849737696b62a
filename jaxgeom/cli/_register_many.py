"""`jaxgeom register-many TARGET SCAN ...`."""

import jax
import numpy as np

from .. import PointCloud, register_many, stack
from ..io import load_cloud
from ._alignment import facts, matrix_lines, settings, sound
from ._main import CHECK, OK
from ._report import Stages, say, write_report


def run(arguments) -> int:
    """Align all scans in one call; every one has its own status."""
    stages = Stages()
    with stages.stage("read"):
        target = load_cloud(arguments.target)
        scans = [load_cloud(path) for path in arguments.sources]
    with stages.stage("align"):
        chosen = settings(arguments, target)
        batch = stack([PointCloud(scan.points) for scan in scans])
        found = register_many(batch, PointCloud(target.points), **chosen)
    items = [jax.tree.map(lambda x, i=i: x[i], found) for i in range(len(scans))]
    for path, item in zip(arguments.sources, items, strict=True):
        told = facts(item)
        say(f"{path}: {told['status']}, rmse {told['rmse']:.4g}, ")
        say(f"  fitness {told['fitness']:.3f}, T_target_source")
        for line in matrix_lines(item.target_from_source):
            say(f"  {line}")
    if arguments.report:
        results = [facts(item) for item in items]
        named = dict(zip(arguments.sources, results, strict=True))
        write_report(
            arguments.report,
            parameters=vars(arguments),
            result=named,
            seconds=stages.seconds,
        )
    return OK if np.all([sound(item) for item in items]) else CHECK
