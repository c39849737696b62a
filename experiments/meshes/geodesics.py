"""How near geodesic distances come to the exact ones, and how long they take (CPU).

    JAXGEOM_DATA=... python experiments/meshes/geodesics.py --meshes bunny nefertiti
    JAXGEOM_DATA=... python experiments/meshes/geodesics.py --times
    JAXGEOM_DATA=... python experiments/meshes/geodesics.py --picture geodesics.png

Exact distances over the faces come from libigl (window propagation); potpourri3d has
the heat method with a direct solver, in double precision. Ours run in single precision.
All vertices are targets, none is left out but the source itself (distance zero):
relative errors in percent, mean, 99th percentile and largest, and the largest error in
percent of the largest distance. Seconds are those of a second call. Then the order of
convergence on spheres, against great circles.
"""

import argparse
import os
import time

import igl
import jax
import jax.numpy as jnp
import numpy as np
import potpourri3d
import trimesh
from matplotlib import pyplot

from jaxgeom import TriangleMesh
from jaxgeom.fields import Camera
from jaxgeom.meshes import (
    Heat,
    Unfolding,
    geodesic_distance,
    icosphere,
    vertex_neighbors,
)
from jaxgeom.render import render_mesh, save_png, side_by_side

SOURCES = 3


def load(name):
    """A mesh of the shared data, in single precision."""
    path = os.path.join(os.environ["JAXGEOM_DATA"], "meshes", f"{name}.ply")
    read = trimesh.load(path, process=False)
    vertices = jnp.asarray(np.asarray(read.vertices), jnp.float32)
    return TriangleMesh(vertices, jnp.asarray(np.asarray(read.faces), jnp.int32))


def exact(vertices, faces, source):
    """Exact distances over the faces, and the seconds they took."""
    none = np.array([], int)
    everything = np.arange(len(vertices))
    start = time.perf_counter()
    found = igl.exact_geodesic(
        vertices, faces, np.array([source]), none, everything, none
    )
    return found, time.perf_counter() - start


def ours(mesh):
    """name -> a function from a source to its distances, compiled."""
    table = vertex_neighbors(mesh)
    unfold = jax.jit(lambda m, s: geodesic_distance(m, s, Unfolding()))
    heat = jax.jit(lambda m, s, t: geodesic_distance(m, s, Heat(t)))
    return {
        "unfolding": lambda s: unfold(mesh, jnp.array([s])),
        "heat": lambda s: heat(mesh, jnp.array([s]), table),
    }


def timed(function, source):
    """The result, and the seconds of a second call."""
    jax.block_until_ready(function(source))
    start = time.perf_counter()
    found = jax.block_until_ready(function(source))
    return found, time.perf_counter() - start


def show(name, found, truth, source, seconds, note=""):
    """One line of errors in percent."""
    others = np.arange(len(truth)) != source
    gap = np.abs(np.asarray(found, np.float64) - truth)[others]
    relative = 100 * gap / truth[others]
    whole = 100 * gap.max() / truth.max()
    print(
        f"  {name:22s} mean {relative.mean():6.3f}"
        f"  99 % {np.quantile(relative, 0.99):6.3f}"
        f"  largest {relative.max():7.3f}  of the range {whole:6.3f}"
        f"  {seconds:7.3f} s  {note}"
    )
    return relative


def compare(name):
    """All methods on a mesh of the shared data."""
    mesh = load(name)
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    solver = potpourri3d.MeshHeatMethodDistanceSolver(vertices, faces)
    solver.compute_distance(0)
    methods = ours(mesh)
    sources = np.random.default_rng(0).choice(len(vertices), SOURCES, replace=False)
    for source in sources:
        truth, seconds = exact(vertices, faces, source)
        print(
            f"{name}, {len(vertices)} vertices, source {source}:"
            f" exact in {seconds:.1f} s"
        )
        for method, function in methods.items():
            found, seconds = timed(function, int(source))
            note = f"{int(found.steps)} steps"
            show(method, found.distances, truth, source, seconds, note)
        start = time.perf_counter()
        found = solver.compute_distance(source)
        seconds = time.perf_counter() - start
        show("potpourri3d, prefactored", found, truth, source, seconds)


def times(name):
    """Seconds for one source, without exact distances: medians of five."""
    mesh = load(name)
    vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    factor = lambda _: potpourri3d.MeshHeatMethodDistanceSolver(vertices, faces)
    solver = factor(0)
    methods = ours(mesh) | {
        "potpourri3d, factorisation": factor,
        "potpourri3d, solution": solver.compute_distance,
    }
    for method, function in methods.items():
        seconds = np.median([timed(function, 100)[1] for _ in range(5)])
        print(f"{name}, {len(vertices)} vertices, {method}: {seconds:.3f} s")


def order():
    """Mean errors against great circles, from mesh to mesh of half the edge."""
    last = {}
    for n in (2, 3, 4, 5):
        mesh = icosphere(n)
        unit = np.asarray(mesh.vertices, float)
        source = len(unit) // 3
        truth = np.arccos(np.clip(unit @ unit[source], -1, 1))
        for name, function in ours(mesh).items():
            found = function(source).distances
            error = np.mean(np.abs(np.asarray(found) - truth))
            rate = np.log2(last[name] / error) if name in last else np.nan
            print(
                f"sphere, {len(unit)} vertices, {name}: {error:.5f}, order {rate:.2f}"
            )
            last[name] = error


def refined(vertices, faces, values):
    """Every face split in four, the values interpolated."""
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1), axis=-1)
    unique, middle = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    middle = middle.reshape(-1, 3) + len(vertices)
    grow = lambda x: np.concatenate([x, x[unique].mean(axis=1)])
    corner = [
        np.stack([faces[:, d], middle[:, d], middle[:, d - 1]], -1) for d in range(3)
    ]
    return grow(vertices), np.concatenate([*corner, middle]), grow(values)


def banded(mesh, distance):
    """The mesh, finer, with bands of distance in the attribute `colors`."""
    parts = np.asarray(mesh.vertices, float), np.asarray(mesh.faces), distance
    for _ in range(2):
        parts = refined(*parts)
    vertices, faces, distance = parts
    at = distance / distance.max()
    band = np.clip(0.5 + 3 * np.sin(2 * np.pi * 18 * at), 0, 1)
    color = pyplot.get_cmap("viridis")(at)[:, :3]
    color = color * (0.35 + 0.65 * band)[:, None]
    attributes = {"colors": color.astype(np.float32)}
    return TriangleMesh(vertices.astype(np.float32), faces, None, attributes)


def picture(path):
    """Bands of distance on the bunny from the tip of an ear, both methods."""
    mesh = load("bunny")
    vertices = np.asarray(mesh.vertices, float)
    middle = (vertices.max(axis=0) + vertices.min(axis=0)) / 2
    size = np.ptp(vertices, axis=0).max()
    eye = middle + size * np.array([-0.55, 0.35, 2.1])
    camera = Camera(eye, middle, (0.0, 1.0, 0.0))
    source = int(np.argmax(vertices[:, 1]))
    views = []
    for function in ours(mesh).values():
        distance = np.asarray(function(source).distances, float)
        views.append(render_mesh(banded(mesh, distance), camera, size=(520, 520)))
    save_png(path, side_by_side(views))


def main():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--meshes", nargs="*", default=["bunny"])
    parser.add_argument("--picture")
    parser.add_argument("--times", action="store_true")
    options = parser.parse_args()
    if options.picture:
        picture(options.picture)
        return
    for name in options.meshes:
        (times if options.times else compare)(name)
    if not options.times:
        order()


if __name__ == "__main__":
    main()
