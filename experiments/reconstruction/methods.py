"""Poisson, wavelets, smooth signed distance and screened Poisson on the same points.

    JAXGEOM_DATA=... python experiments/reconstruction/methods.py --picture methods.png

Default settings, 128 nodes a side; units as in `accuracy.py`. The gargoyle has no true
mesh: there the row says how far the points are from the surface (RMS, thousandths).
"""

import argparse
import os
import sys
import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxgeom as jg
from jaxgeom.io import load_cloud
from jaxgeom.meshes import topology
from jaxgeom.reconstruction import SSD, Poisson, ScreenedPoisson, Wavelet
from jaxgeom.render import Camera, render_mesh, save_png, side_by_side
from jaxgeom.shapes import PointCloud

sys.path.insert(0, os.path.dirname(__file__))
import accuracy
import cases

METHODS = {
    "poisson": Poisson(),
    "wavelet": Wavelet(),
    "ssd": SSD(),
    "screened": ScreenedPoisson(),
}
# Where the camera stands, and whether y is up (1) or down there.
SIDES = {
    "anchor": ((1, 0.6, 0.8), 1),
    "dc": ((0.5, 0.3, 1), 1),
    "gargoyle": ((0.5, 0.3, 1), -1),
    "nefertiti-7": ((0.3, 0.1, 1), 1),
}


def gargoyle(folder):
    """The scan in its unit box, without a truth."""
    scan = load_cloud(f"{folder}/benchmark/gargoyle_scan.ply")
    points = np.asarray(scan.points, np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    unit = (points - (low + high) / 2) / (high - low).max()
    cloud = PointCloud(unit.astype(np.float32), np.asarray(scan.normals))
    return cases.Case("gargoyle", cloud, None, 7)


def line(case, name, method):
    """Print one line of the table; the mesh."""
    start = time.perf_counter()
    out = jg.reconstruct(case.cloud, resolution=2**case.depth, method=method)
    seconds = time.perf_counter() - start
    facts, stats = topology(out.mesh), out.stats
    points = np.asarray(case.cloud.points)
    fit = np.sqrt(np.mean(accuracy._to_mesh(points, out.mesh) ** 2))
    text = f"{case.name:12s} {name:9s} points to mesh {1e3 * fit:.3f}"
    if case.truth is not None:
        found = accuracy.errors(out.mesh, case.truth).items()
        text += " " + " ".join(f"{k} {v:.3f}" for k, v in found)
    closed = bool(facts.is_closed & facts.is_manifold)
    print(
        f"{text} euler {int(facts.euler)} bodies {int(facts.num_components)} "
        f"{'closed' if closed else 'open'} steps {int(stats.steps)} "
        f"residual {float(stats.residual):.1e} {seconds:.1f} s",
        flush=True,
    )
    return out.mesh


def view(mesh, side, up=1):
    """The surface from one side."""
    unit = eqx.tree_at(lambda m: m.vertices, mesh, np.float32(mesh.vertices))
    eye = 2.2 * np.asarray(side) / np.linalg.norm(side)
    camera = Camera(jnp.float32(eye), up=jnp.array([0.0, float(up), 0.0]))
    return render_mesh(unit, camera, size=(360, 360))


def main():
    """Print the table, write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", default=os.environ["JAXGEOM_DATA"])
    parser.add_argument("--cases", nargs="+", default=list(SIDES))
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--picture", help="one row a case, one column a method")
    options = parser.parse_args()
    rows = []
    for name in options.cases:
        if name == "gargoyle":
            case = gargoyle(options.data)
        else:
            (case,) = cases.load(options.data, [name])
        meshes = [line(case, m, METHODS[m]) for m in options.methods]
        if options.picture:
            rows.append(side_by_side([view(m, *SIDES[name]) for m in meshes]))
    if options.picture:
        save_png(options.picture, np.concatenate(rows, axis=0))


if __name__ == "__main__":
    main()
