"""`jaxgeom mesh SCENE.py:NAME -o MESH`."""

import jax.numpy as jnp
import numpy as np

from .. import Grid
from ..fields import NarrowBand, claims
from ..io import save_mesh
from ..isosurface import (
    AdaptiveDualContouring,
    DualContouring,
    DualGridCubes,
    DualMarchingCubes,
    FlexiCubes,
    MarchingCubes,
    extract,
)
from ..meshes import topology
from ._main import CHECK, OK
from ._report import Stages, say, write_report
from ._scene import box_of, load_scene

_METHODS = {
    "marching-cubes": lambda t: MarchingCubes(),
    "dual-contouring": lambda t: AdaptiveDualContouring(t) if t else DualContouring(),
    "dual-marching-cubes": lambda t: DualMarchingCubes(),
    "dual-grid": lambda t: DualGridCubes(t, levels=4 if t else 0),
    "flexicubes": lambda t: FlexiCubes(),
}
# Nodes along an axis from which on only bricks near the surface are sampled.
_LARGE = 256
# Cells left free around the box, so that the surface does not touch the border.
_MARGIN = 2


def run(arguments) -> int:
    """Extract the surface of a field, check it, write it, report."""
    stages = Stages()
    with stages.stage("read"):
        field = load_scene(arguments.scene)
        low, high = box_of(field, arguments.bounds, arguments.scene)
    grid = _grid_in(low, high, arguments.resolution)
    method = _METHODS[arguments.method](arguments.tolerance)
    with stages.stage("extract"):
        out = _extract(field, grid, arguments.level, method)
    if len(out.mesh.faces) == 0:
        say(f"no surface of {arguments.scene} in {_box(low, high)}")
        return CHECK
    check = topology(out.mesh)
    facts = {name: getattr(check, name).item() for name in check.__dataclass_fields__}
    with stages.stage("write"):
        save_mesh(arguments.output, out.mesh)
    sound = bool(check.is_watertight)
    sizes = {"vertices": len(out.mesh.vertices), "faces": len(out.mesh.faces)}
    if arguments.report:
        write_report(
            arguments.report,
            status="ok" if sound else "failed its check",
            parameters={**vars(arguments), "grid": list(grid.shape)},
            result={**sizes, "watertight": sound, **facts},
            seconds=stages.seconds,
        )
    say(
        f"grid {'x'.join(map(str, grid.shape))}: {sizes['vertices']} vertices, "
        f"{sizes['faces']} faces, {'watertight' if sound else 'not watertight'}, "
        f"{sum(stages.seconds.values()):.1f} s: {arguments.output}"
    )
    return OK if sound else CHECK


def _extract(field, grid, level, method):
    """The closed mesh; in bricks where the grid is large and the field allows it."""
    bricks = isinstance(method, MarchingCubes) and max(grid.shape) >= _LARGE
    if bricks and jnp.isfinite(claims(field).lipschitz):
        band = NarrowBand.around(field, grid, level, closed=True)
        return extract(band, method=method)
    return extract(field, grid, level, method=method, closed=True)


def _grid_in(low, high, resolution) -> Grid:
    """Cubic cells, `resolution` nodes along the longest side of the box."""
    spacing = np.max(high - low) / (resolution - 1 - 2 * _MARGIN)
    shape = np.ceil((high - low) / spacing).astype(int) + 1 + 2 * _MARGIN
    origin = (low + high) / 2 - spacing * (shape - 1) / 2
    asarray = lambda x: jnp.asarray(x, jnp.result_type(float))
    return Grid(asarray(origin), asarray([spacing] * 3), tuple(map(int, shape)))


def _box(low, high):
    return " x ".join(f"[{a:g}, {b:g}]" for a, b in zip(low, high, strict=True))
