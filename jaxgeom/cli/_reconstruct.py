"""`jaxgeom reconstruct SCAN -o MESH`."""

import sys

from .. import PointCloud, reconstruct
from ..io import load_cloud, save_mesh
from ..reconstruction import Poisson, ScreenedPoisson
from ._main import CHECK, OK
from ._report import Stages, mesh_facts, say, solver_facts, status_of, write_report


def run(arguments) -> int:
    """Reconstruct, check, write, report."""
    stages = Stages()
    with stages.stage("read"):
        cloud = _read(arguments)
    resolution = _resolution(arguments)
    with stages.stage("reconstruct"):
        out = reconstruct(
            cloud,
            resolution=resolution,
            method=_method(arguments.point_weight),
            padding=arguments.scale - 1,
            trim=arguments.trim,
            min_component=arguments.min_component,
        )
    with stages.stage("write"):
        save_mesh(arguments.output, out.mesh)
    facts, status = mesh_facts(out), status_of(out)
    for note in out.notes:
        print(f"jaxgeom: note: {note}", file=sys.stderr)
    if status != "ok":
        print(f"jaxgeom: status: {status}", file=sys.stderr)
    sound = facts["is_manifold"] and (facts["is_closed"] or arguments.trim is not None)
    if arguments.report:
        parameters = {**vars(arguments), "resolution": resolution, **solver_facts(out)}
        write_report(
            arguments.report,
            status=status if sound else "failed its check",
            parameters=parameters,
            input={"points": len(cloud.points), "path": arguments.input},
            result=facts,
            notes=list(out.notes),
            seconds=stages.seconds,
        )
    say(
        f"{len(cloud.points)} points, grid {resolution}^3: "
        f"{facts['vertices']} vertices, "
        f"{facts['faces']} faces, {'watertight' if facts['watertight'] else 'open'}, "
        f"{sum(stages.seconds.values()):.1f} s: {arguments.output}"
    )
    return OK if sound else CHECK


def _read(arguments) -> PointCloud:
    cloud = load_cloud(arguments.input)
    normals = None if arguments.ignore_normals else cloud.normals
    if arguments.flip_normals and normals is not None:
        normals = -normals
    return PointCloud(cloud.points, normals, cloud.mask, cloud.attributes)


def _resolution(arguments) -> int:
    if arguments.depth is not None:
        return 2**arguments.depth
    return 128 if arguments.resolution is None else arguments.resolution


def _method(point_weight):
    return Poisson() if point_weight == 0 else ScreenedPoisson(screening=point_weight)
