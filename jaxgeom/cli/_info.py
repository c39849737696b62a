"""`jaxgeom info FILE`."""

import numpy as np

from .. import PointCloud
from ..io import load_cloud
from ..meshes import topology
from ..pipelines import memory_needed
from ._files import load_shape
from ._main import OK
from ._report import say


def run(arguments) -> int:
    """Print counts, bounds, and what a reconstruction would need."""
    shape = load_shape(arguments.input)
    mesh = None if isinstance(shape, PointCloud) else shape
    cloud = load_cloud(arguments.input) if mesh is not None else shape
    points, precision = np.asarray(cloud.points, np.float64), cloud.points.dtype.name
    finite = np.isfinite(points).all(axis=1)
    say(f"{arguments.input}: {len(points)} points, {precision}")
    say(f"  carries: {_carried(cloud)}")
    if mesh is not None:
        say(f"  mesh: {_mesh_line(mesh)}")
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


def _mesh_line(mesh):
    check = topology(mesh)
    state = "watertight" if check.is_closed & check.is_manifold else "open"
    return f"{len(mesh.faces)} faces, {state}, {int(check.num_components)} bodies"


def _carried(cloud):
    names = ["normals"] if cloud.normals is not None else ["no normals"]
    return ", ".join(names + sorted(cloud.attributes))


def _row(values):
    return "(" + ", ".join(f"{v:.6g}" for v in values) + ")"
