"""`jaxgeom reconstruct SCAN -o MESH`."""

from .. import PointCloud, reconstruct
from ..io import load_cloud
from ._report import Stages
from ._surface import finish, settings


def run(arguments) -> int:
    """Reconstruct, check, write, report."""
    stages = Stages()
    with stages.stage("read"):
        cloud = _read(arguments)
    with stages.stage("reconstruct"):
        out = reconstruct(cloud, **settings(arguments))
    inputs = {"points": len(cloud.points), "path": arguments.input}
    return finish(arguments, out, stages, inputs)


def _read(arguments) -> PointCloud:
    cloud = load_cloud(arguments.input)
    normals = None if arguments.ignore_normals else cloud.normals
    if arguments.flip_normals and normals is not None:
        normals = -normals
    return PointCloud(cloud.points, normals, cloud.mask, cloud.attributes)
