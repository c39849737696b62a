"""`jaxgeom demo`: a statue of distance fields, scanned, reconstructed, checked."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np

from .. import PointCloud, reconstruct
from ..fields import Camera, demo_statue, scan
from ..io import save_cloud, save_mesh
from ..render import (
    render_cloud,
    render_field,
    render_mesh,
    save_html,
    save_png,
    side_by_side,
)
from ._main import CHECK, OK
from ._report import Stages, mesh_facts, say, solver_facts, status_of, write_report

_RAYS = 160
_NOISE = 0.004
_EYES = [
    (2.6, -2.2, 0.6),
    (-2.6, -2.2, 0.8),
    (2.2, 2.6, 0.4),
    (-2.2, 2.6, 0.6),
    (0.3, -2.4, 2.6),
    (0.2, 0.5, -3.4),
]
_PICTURE = (420, 420)


def run(arguments) -> int:
    """Make, scan, reconstruct, compare with the truth, write everything."""
    folder, stages = pathlib.Path(arguments.out), Stages()
    folder.mkdir(parents=True, exist_ok=True)
    statue = demo_statue()
    with stages.stage("scan"):
        cloud = _scan(statue, arguments.seed)
    with stages.stage("reconstruct"):
        out = reconstruct(cloud, resolution=arguments.resolution)
    with stages.stage("compare"):
        rms = _rms_error(statue, out.mesh)
    with stages.stage("write"):
        save_cloud(folder / "scan.ply", cloud)
        save_mesh(folder / "mesh.ply", out.mesh)
        save_html(folder / "mesh.html", out.mesh)
    with stages.stage("draw"):
        save_png(folder / "demo.png", _picture(statue, cloud, out.mesh))
    facts = mesh_facts(out)
    sound = facts["watertight"] and facts["num_components"] == 1 and rms < 2 * _NOISE
    write_report(
        folder / "report.json",
        status=status_of(out) if sound else "failed its check",
        parameters={**vars(arguments), "noise_added": _NOISE, **solver_facts(out)},
        result={**facts, "rms_to_the_true_surface": rms},
        notes=list(out.notes),
        seconds=stages.seconds,
    )
    _tell(cloud, facts, rms, stages, folder)
    return OK if sound else CHECK


def _scan(statue, seed) -> PointCloud:
    cameras = [Camera(position=eye) for eye in _EYES]
    run = jax.jit(lambda key: scan(statue, cameras, rays=_RAYS, noise=_NOISE, key=key))
    seen = run(jax.random.key(seed)).trim()
    return PointCloud(seen.points, seen.normals)


def _rms_error(statue, mesh) -> float:
    """Root mean square distance of the vertices to the true surface.

    The value over the length of the gradient is the distance to first order, also
    where the blends make the field less than a distance.
    """
    value_and_slope = jax.jit(jax.vmap(jax.value_and_grad(statue)))
    value, slope = value_and_slope(jnp.asarray(mesh.vertices, jnp.float32))
    distance = np.asarray(value) / np.linalg.norm(np.asarray(slope), axis=1)
    return float(np.sqrt(np.mean(distance**2)))


def _picture(statue, cloud, mesh):
    camera = Camera.around(mesh.vertices)
    return side_by_side(
        [
            render_field(statue, camera, size=_PICTURE),
            render_cloud(cloud, camera, size=_PICTURE),
            render_mesh(mesh, camera, size=_PICTURE),
        ]
    )


def _tell(cloud, facts, rms, stages, folder):
    state = "watertight" if facts["watertight"] else "NOT watertight"
    say(f"a statue was scanned from {len(_EYES)} sides: {len(cloud.points)} points, ")
    say(f"  noise {_NOISE} on a height of 2")
    say(f"reconstructed: {facts['vertices']} vertices, {facts['faces']} faces,")
    say(
        f"  {state}, {facts['num_components']} body, genus {facts['genus']}, "
        f"rms distance to the true surface {rms:.4f}"
    )
    say(f"seconds: {', '.join(f'{k} {v:.1f}' for k, v in stages.seconds.items())}")
    for name in ("scan.ply", "mesh.ply", "mesh.html", "demo.png", "report.json"):
        say(f"  {folder / name}")
