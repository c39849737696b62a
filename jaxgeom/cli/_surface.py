"""What the commands that make a mesh share: their settings, and how they end."""

import sys

from ..io import save_mesh
from ..reconstruction import Poisson, ScreenedPoisson
from ._main import CHECK, OK
from ._report import Stages, mesh_facts, say, solver_facts, status_of, write_report


def settings(arguments) -> dict:
    """The keyword arguments of `reconstruct`."""
    return {
        "resolution": _resolution(arguments),
        "method": method_of(arguments.point_weight),
        "padding": arguments.scale - 1,
        "trim": arguments.trim,
        "min_component": arguments.min_component,
    }


def method_of(weight: float | None):
    """The solver with a screening weight: zero is plain Poisson."""
    return Poisson() if weight == 0 else ScreenedPoisson(screening=weight)


def finish(arguments, out, stages: Stages, inputs: dict, sound: bool = True) -> int:
    """Write the mesh and the report, say what came out, and return the exit code.

    `out` is the `Reconstruction`, `inputs` go into the report as they are; `sound` is
    False where an earlier step failed its own check.
    """
    with stages.stage("write"):
        save_mesh(arguments.output, out.mesh)
    facts, status = mesh_facts(out), status_of(out)
    for note in out.notes:
        print(f"jaxgeom: note: {note}", file=sys.stderr)
    if status != "ok":
        print(f"jaxgeom: status: {status}", file=sys.stderr)
    closed = facts["is_closed"] or arguments.trim is not None
    sound = sound and facts["is_manifold"] and closed
    resolution = _resolution(arguments)
    if arguments.report:
        parameters = {**vars(arguments), "resolution": resolution, **solver_facts(out)}
        write_report(
            arguments.report,
            status=status if sound else "failed its check",
            parameters=parameters,
            input=inputs,
            result=facts,
            notes=list(out.notes),
            seconds=stages.seconds,
        )
    say(
        f"{inputs['points']} points, grid {resolution}^3: "
        f"{facts['vertices']} vertices, "
        f"{facts['faces']} faces, {'watertight' if facts['watertight'] else 'open'}, "
        f"{sum(stages.seconds.values()):.1f} s: {arguments.output}"
    )
    return OK if sound else CHECK


def _resolution(arguments) -> int:
    if arguments.depth is not None:
        return 2**arguments.depth
    return 128 if arguments.resolution is None else arguments.resolution
