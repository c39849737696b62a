"""How many scans a second `jaxgeom batch` reconstructs, beside loops.

    python -m experiments.scale.meshes FOLDER [--scans 48] [--resolution 64]

Flasks as in throughput.py, but seen from all sides: 500 to 5 000 points with noise of
0.2 % of the height and no normals. Ours is one `run_batch` (files, states and meshes
included), and then a loop over `reconstruct` in the same process. The peer is a loop
over Open3D's Poisson reconstruction at the same resolution, with normals estimated and
oriented by it. Prints the rate after the first chunk of each size, which compiles, and
errors: the median and the 99 % quantile of |f| at the vertices, f the field that the
scan was made from, in percent of the height. Run it from the root of the repository.
"""

import argparse
import csv
import json
import os
import pathlib
import time

import jax
import numpy as np

from experiments.registration import speed
from experiments.scale import throughput
from experiments.scale.throughput import flask, rate_of
from jaxgeom import reconstruct
from jaxgeom.batch import Reconstructing, run_batch
from jaxgeom.io import load_mesh

HEIGHT, LOOP, CHUNK = 0.9, 12, 8


def make(folder, scans):
    """Scans, manifest and the numbers of the flasks."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(2)
    numbers = rng.uniform(-1, 1, (scans, throughput.NUMBERS)).astype(np.float32)
    with open(folder / "manifest.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["id", "source"])
        for i, u in enumerate(numbers):
            points, _, found = map(np.asarray, throughput.surface(u, jax.random.key(i)))
            scan = points[found][
                : rng.integers(throughput.SMALLEST, throughput.LARGEST)
            ]
            scan = scan + throughput.NOISE * HEIGHT * rng.normal(size=scan.shape)
            np.save(folder / f"{i}.npy", scan.astype(np.float32))
            rows.writerow([i, folder / f"{i}.npy"])
    np.save(folder / "numbers.npy", numbers)


@jax.jit
def offsets(u, vertices):
    """|f| / height at points [n, 3]."""
    return abs(jax.vmap(flask(u))(vertices)) / HEIGHT


def told(meshes, numbers):
    """The errors of the meshes in words."""
    gaps = [np.asarray(offsets(u, v)) for u, v in zip(numbers, meshes, strict=True)]
    gaps = 100 * np.concatenate(gaps)
    return f"median {np.median(gaps):.2f} %, 99 % {np.quantile(gaps, 0.99):.2f} %"


def batched(folder, resolution):
    """Scans a second after the first chunk of each size, and the states."""
    marks, start = [], time.perf_counter()
    tell = lambda text: marks.append((time.perf_counter() - start, text))
    how = Reconstructing({"resolution": resolution}, {"resolution": resolution})
    out = folder / "out"
    rest = {"reconstructing": how, "chunk": CHUNK, "tell": tell}
    tally = run_batch(folder / "manifest.csv", out, **rest)
    total = time.perf_counter() - start
    chunks = [mark for mark in marks if " at once" in mark[1]]
    rate, sizes, _ = rate_of(chunks, total)
    print(f"run_batch, {CHUNK} at once: {tally}, {total:.0f} s, {sizes} sizes")
    return rate, [json.loads(p.read_text()) for p in out.rglob("*/*/*.json")]


def by_open3d(points, depth):
    """Vertices of Open3D's reconstruction."""
    open3d = speed.open3d
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(16))
    cloud.orient_normals_consistent_tangent_plane(16)
    run = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson
    return np.asarray(run(cloud, depth=depth, n_threads=2)[0].vertices)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--scans", type=int, default=48)
    parser.add_argument("--resolution", type=int, default=64)
    args = parser.parse_args()
    # As `jaxgeom batch` does.
    jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))
    if not (args.folder / "numbers.npy").exists():
        make(args.folder, args.scans)
    numbers = np.load(args.folder / "numbers.npy")
    rate, states = batched(args.folder, args.resolution)
    made = {int(s["id"]): s["mesh"] for s in states if s["status"] != "failed"}
    ids = sorted(made)
    meshes = [load_mesh(args.folder / "out" / made[i]).vertices for i in ids]
    print(f"  {rate:.2f} scans a second; {told(meshes, numbers[ids])}", flush=True)
    # As many small and large ones as the batch has.
    some = range(0, len(numbers), max(1, len(numbers) // LOOP))
    scans = [np.load(args.folder / f"{i}.npy") for i in some]
    loops = {"reconstruct": lambda p: reconstruct(p, resolution=args.resolution)}
    vertices = {"reconstruct": lambda out: np.asarray(out.mesh.vertices)}
    if speed.open3d is not None:
        depth = round(np.log2(args.resolution))
        loops["open3d"] = lambda p: by_open3d(p, depth)
        vertices["open3d"] = lambda out: out
    for name, run in loops.items():
        if name == "reconstruct":
            [run(scan) for scan in scans]
        start = time.perf_counter()
        found = [run(scan) for scan in scans]
        each = len(scans) / (time.perf_counter() - start)
        errors = told([vertices[name](x) for x in found], numbers[list(some)])
        print(f"loop over {name}: {each:.2f} scans a second, batch {rate / each:.2f}")
        print("  " + errors, flush=True)


if __name__ == "__main__":
    main()
