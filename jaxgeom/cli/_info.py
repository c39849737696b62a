"""`jaxgeom info FILE`."""

import numpy as np

from ..io import load_cloud
from ..pipelines import memory_needed
from ._main import OK
from ._report import say


def run(arguments) -> int:
    """Print counts, bounds, and what a reconstruction would need."""
    cloud = load_cloud(arguments.input)
    points = np.asarray(cloud.points, np.float64)
    finite = np.isfinite(points).all(axis=1)
    say(f"{arguments.input}: {len(points)} points, {points.dtype.name} on reading")
    say(f"  carries: {_carried(cloud)}")
    if (~finite).any():
        say(f"  NaN or infinite: {(~finite).sum()} points")
    if finite.any():
        low, high = points[finite].min(axis=0), points[finite].max(axis=0)
        say(f"  bounds: {_row(low)} to {_row(high)}; extent {_row(high - low)}")
        repeated = len(points) - len(np.unique(points, axis=0))
        say(f"  exact duplicates: {repeated}")
    sizes = [2**depth for depth in range(6, 11)]
    needs = ", ".join(f"{n}^3 {memory_needed(n) / 2**30:.2g} GiB" for n in sizes)
    say(f"  memory to reconstruct, at most: {needs}")
    return OK


def _carried(cloud):
    names = ["normals"] if cloud.normals is not None else ["no normals"]
    return ", ".join(names + sorted(cloud.attributes))


def _row(values):
    return "(" + ", ".join(f"{v:.6g}" for v in values) + ")"
