"""How fast nearest neighbors are beside scipy's k-d tree (CPU), build and query.

    python experiments/neighbors/speed.py DATA/meshes/bunny.ply --sizes 10000 100000

Points and queries are two samples of the surface, the queries turned by 5 degrees and
moved a little, as in registration; in the half-overlapping case they are moved by half
the extent. The gate is four mean spacings. All answers are checked against scipy. Ours
and scipy take turns; prints medians in ms (build + query of one new set of points) and
the ratios to scipy with one thread and with all (below 1 is faster).
"""

import argparse
import time

import jax
import numpy as np
import trimesh
from scipy.spatial import cKDTree

from jaxgeom.neighbors import HostTree, KdTree, build, knn

BACKENDS = {"tree": KdTree(), "host tree": HostTree()}


def clouds(mesh, n, shift):
    """Points, queries and the gate."""
    points, _ = trimesh.sample.sample_surface(mesh, n, seed=1)
    queries, _ = trimesh.sample.sample_surface(mesh, n, seed=2)
    extent = mesh.extents
    turn = trimesh.transformations.rotation_matrix(np.radians(5), [1, 2, 3])
    queries = trimesh.transform_points(queries, turn) + extent * [shift, 0.01, 0]
    gate = 4 * np.sqrt(mesh.area / n)
    return points.astype(np.float32), queries.astype(np.float32), gate


def search(backend):
    """The compiled search: distances."""

    @jax.jit
    def run(points, queries, gate):
        near = knn(build(points, backend=backend), queries, 1, max_distance=gate)
        return near.distances[:, 0]

    return run


def scipy_search(points, queries, gate, workers):
    """The distances by scipy."""
    tree = cKDTree(points)
    return tree.query(queries, distance_upper_bound=gate, workers=workers)[0]


def medians(runs, repeats):
    """Name -> median seconds, the runs taking turns."""
    times = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(t)) for name, t in times.items()}


def case(name, points, queries, gate, repeats):
    """One row of the table."""
    rng = np.random.default_rng(0)
    fresh = lambda: points[rng.permutation(len(points))]
    want = scipy_search(points, queries, gate, 1)
    runs = {
        "scipy": lambda: scipy_search(fresh(), queries, gate, 1),
        "scipy all": lambda: scipy_search(fresh(), queries, gate, -1),
    }
    worst = 0.0
    for label, backend in BACKENDS.items():
        run = search(backend)
        found = np.asarray(run(points, queries, gate))
        assert (np.isinf(found) == np.isinf(want)).mean() > 0.9999
        both = np.isfinite(found) & np.isfinite(want)
        worst = max(worst, np.abs(found[both] - want[both]).max(initial=0))
        runs[label] = lambda run=run: run(fresh(), queries, gate).block_until_ready()
    ms = medians(runs, repeats)
    row = "".join(f"{1e3 * ms[k]:10.1f}" for k in runs)
    ratios = "".join(
        f"{ms[k] / ms['scipy']:8.2f}{ms[k] / ms['scipy all']:8.2f}" for k in BACKENDS
    )
    print(f"{name:26}{row}{ratios}   error {worst:.1e}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh")
    parser.add_argument("--sizes", type=int, nargs="+", default=[10_000, 100_000])
    parser.add_argument("--repeats", type=int, default=7)
    args = parser.parse_args()
    mesh = trimesh.load(args.mesh, process=False)
    labels = ["scipy", "scipy all", *BACKENDS]
    print(f"{'ms':26}" + "".join(f"{x:>10}" for x in labels) + "   ratios to both")
    for n in args.sizes:
        for name, shift in (("aligned", 0.01), ("half overlapping", 0.5)):
            points, queries, gate = clouds(mesh, n, shift)
            case(f"{n} {name}", points, queries, np.float32(np.inf), args.repeats)
            case(f"{n} {name}, gated", points, queries, np.float32(gate), args.repeats)


if __name__ == "__main__":
    main()
