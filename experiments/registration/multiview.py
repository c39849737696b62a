"""The ten raw scans of the bunny: aligned together without any pose, then one mesh.

    JAXGEOM_DATA=... python experiments/registration/multiview.py --picture bunny.png

Prints the rotation (degrees) and the displacement (mm, at the center of the scan) of
every pose against the published ones, in the frame of the first scan, once with the
scanner's position (far along +z) and once without any; then what the mesh is. The
picture shows the scans as they are stored, as they were placed, and the mesh.
"""

import argparse
import os
import pathlib
import time

import numpy as np
from global_start import poses

import jaxgeom as jg
from jaxgeom.render import Camera, render_cloud, render_mesh, save_png, side_by_side

_SIZE = (420, 420)
# Ten colors of equal lightness, one for each scan.
_COLORS = 0.55 + 0.3 * np.cos(
    2 * np.pi * (np.arange(10)[:, None] / 10 + np.array([0, 1 / 3, 2 / 3]))
)


def errors(found, truth, scans, names):
    """Degrees and millimetres of every scan, the first one being the frame."""
    (first, shift) = truth[names[0]]
    for i, name in enumerate(names):
        turn = first.T @ truth[name][0]
        move = first.T @ (truth[name][1] - shift)
        off = turn.T @ found.rotation[i]
        angle = np.degrees(np.arccos(np.clip((np.trace(off) - 1) / 2, -1, 1)))
        center = scans[name].mean(axis=0)
        here = found.rotation[i] @ center + found.translation[i]
        yield name, angle, 1e3 * np.linalg.norm(turn @ center + move - here)


def painted(clouds):
    """All points in one cloud, a color for each scan."""
    colors = [np.broadcast_to(c, x.shape) for c, x in zip(_COLORS, clouds, strict=True)]
    points = np.concatenate(clouds)
    return jg.PointCloud(points, attributes={"colors": np.concatenate(colors)})


def picture(path, scans, out, truth):
    """Before, after, and the mesh, upright as the published frame is."""
    turn, shift = truth
    upright = lambda x: (np.asarray(x, np.float64) @ turn.T + shift)[:, [2, 0, 1]]
    moved = [
        x @ r.T + t
        for x, r, t in zip(
            scans,
            out.world_from_scan.rotation,
            out.world_from_scan.translation,
            strict=True,
        )
    ]
    before, after = (painted([upright(x) for x in y]) for y in (scans, moved))
    mesh = out.reconstruction.mesh
    mesh = jg.TriangleMesh(upright(mesh.vertices), mesh.faces)
    camera = Camera.around(mesh.vertices, azimuth=20.0, elevation=15.0)
    images = [render_cloud(c, camera, size=_SIZE) for c in (before, after)]
    save_png(path, side_by_side([*images, render_mesh(mesh, camera, size=_SIZE)]))


def main():
    """The table, and the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--picture")
    options = parser.parse_args()
    folder = pathlib.Path(os.environ["JAXGEOM_DATA"]) / "registration/stanford_bunny"
    table, truth = np.load(folder / "bunny_scans.npz"), poses(folder)
    names = list(truth)
    scans = {name: table[f"{name}_xyz"] for name in names}
    for viewpoints in ((0.0, 0.0, 10.0), None):
        start = time.perf_counter()
        out = jg.fuse(
            [jg.PointCloud(x) for x in scans.values()],
            viewpoints=viewpoints,
            resolution=options.resolution,
        )
        seconds = time.perf_counter() - start
        rows = list(errors(out.world_from_scan, truth, scans, names))
        for name, angle, distance in rows:
            print(f"{name:9s} {angle:6.3f} deg {distance:6.3f} mm")
        facts = out.reconstruction.topology
        print(
            f"viewpoints {viewpoints}: worst {max(r[1] for r in rows):.3f} deg, "
            f"{max(r[2] for r in rows):.3f} mm; {jg.RESULTS[out.result] or 'ok'}; "
            f"rmse {1e3 * float(out.views.rmse):.3f} mm; closed "
            f"{bool(facts.is_closed & facts.is_manifold)}, euler {int(facts.euler)}, "
            f"bodies {int(facts.num_components)}; {seconds:.0f} s with compiling",
            flush=True,
        )
        if options.picture and viewpoints is not None:
            picture(options.picture, list(scans.values()), out, truth[names[0]])


if __name__ == "__main__":
    main()
