"""A surface found from a sphere by gradients, beside screened Poisson, at 128^3.

    JAXGEOM_DATA=... python experiments/reconstruction/shape_as_points.py [--picture P]

Units as in `accuracy.py` (the longest side is 1); Chamfer distances (half of the mean
distances of 100 000 points there and back) in thousandths. Screened Poisson sees the
normals; the row `bare` is the same from points alone, and shape as points sees no more
than those. The last row is the distance of two draws from the truth. The gargoyle has
no true mesh: there the row says how far the points of the scan are from points of the
mesh. The pictures show the scan and the three meshes.
"""

import argparse
import os
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

import jaxgeom as jg
from jaxgeom.meshes import sample_surface, topology
from jaxgeom.pipelines import shape_as_points
from jaxgeom.render import Camera, render_cloud, render_mesh, save_png, side_by_side

sys.path.insert(0, os.path.dirname(__file__))
import cases
import methods

SAMPLES, RESOLUTION = 100_000, 128
SIZE = (420, 340)
# Where the camera stands, and what is up.
VIEWS = {
    "gargoyle": ((0.9, -0.4, 2.0), (0.0, -1.0, 0.0)),
    "nefertiti-noisy": ((0.8, 0.4, 1.8), (0.0, 1.0, 0.0)),
}


def samples(mesh, seed):
    mesh = jax.tree.map(jnp.asarray, mesh)
    return np.asarray(sample_surface(mesh, SAMPLES, key=jax.random.key(seed)).points)


def distances(case, mesh):
    """Thousandths, there and back; only from the scan where there is no truth."""
    ours = samples(mesh, 1)
    mean = lambda a, b: 1000 * cKDTree(b).query(a)[0].mean()
    if case.truth is None:
        return f"scan to mesh {mean(np.asarray(case.cloud.points), ours):.3f}"
    truth = samples(case.truth, 2)
    there, back = mean(ours, truth), mean(truth, ours)
    return f"chamfer {(there + back) / 2:.3f} (to {there:.3f}, from {back:.3f})"


def line(case, name, run):
    """Run one method and print its row."""
    start = time.perf_counter()
    mesh = run()
    seconds = time.perf_counter() - start
    euler = int(topology(mesh).euler)
    said = distances(case, mesh)
    print(f"{case.name:16} {name:9} {said}, Euler {euler}, {seconds:.1f} s", flush=True)
    return mesh


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--picture")
    parser.add_argument("--shapes", nargs="+", default=["gargoyle", "nefertiti-noisy"])
    args = parser.parse_args()
    folder, rows = os.environ["JAXGEOM_DATA"], []
    for name in args.shapes:
        if name == "gargoyle":
            case = methods.gargoyle(folder)
        else:
            (case,) = cases.load(folder, [name])
        screened = lambda case=case: (
            jg.reconstruct(case.cloud, resolution=RESOLUTION).mesh
        )
        points = np.asarray(case.cloud.points)
        bare = lambda points=points: jg.reconstruct(points, resolution=RESOLUTION).mesh
        moved = lambda points=points: (
            shape_as_points(points, key=jax.random.key(0)).mesh
        )
        runs = {"screened": screened, "bare": bare, "as points": moved}
        found = [line(case, name, run) for name, run in runs.items()]
        position, up = map(np.array, VIEWS[name])
        camera = Camera(position, up=up)
        draw = lambda m, c=camera: render_mesh(m, c, size=SIZE)
        scan = render_cloud(case.cloud, camera, size=SIZE, radius=0.002)
        rows.append(side_by_side([scan, *map(draw, found)]))
        if case.truth is not None:
            print(f"{case.name:16} the truth {distances(case, case.truth)}")
    if args.picture:
        save_png(args.picture, np.concatenate(rows))


if __name__ == "__main__":
    main()
