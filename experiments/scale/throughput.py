"""How many scans a second `jaxgeom batch` aligns, beside loops over peers.

    python experiments/scale/throughput.py FOLDER [--scans 10000] [--peers 1000]

Flasks of a family of fields (14 numbers each), seen from one side, 500 to 5 000 points,
noise of 0.2 % of the height, turned by 20 degrees and moved by a tenth of the height,
are laid on the mean flask. Scans and manifest are written to FOLDER first. Ours is one
`run_batch` of all of them, files and states included, in a process of its own; the
peers read the same files in a loop, every k-th of them, with normals and trees of the
template made once. Errors are those of the pose in the frame of the template; since
flasks differ, no method reaches zero. Prints rates without the first chunk of each size
(which compiles) and with it, the programs compiled, and the memory as the run goes on.
"""

import argparse
import csv
import functools
import json
import pathlib
import resource
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxgeom.batch import run_batch
from jaxgeom.fields import Box, Cylinder, Torus

try:
    import small_gicp
except ImportError:
    small_gicp = None
try:
    import open3d
except ImportError:
    open3d = None

NUMBERS, CANDIDATES, SMALLEST, LARGEST, TEMPLATE = 8, 12_000, 500, 5_000, 2_000
NOISE, DEGREES, DISTANCE, GATE, MOST_STEPS = 0.002, 20.0, 0.1, 0.15, 50


def flask(u):
    """The flask with parameters u [8] in [-1, 1]: about 1 high."""
    wide = 1 + 0.08 * u
    body = Box(jnp.stack([0.2 * wide[0], 0.12 * wide[1], 0.28 * wide[2]])).rounded(0.05)
    neck = Cylinder(0.06 * wide[3], 0.15, (0.05, 0.0, 0.4))
    grip = Torus(0.13 * wide[4], 0.03 * wide[5])
    grip = grip.rotate(jnp.array([jnp.pi / 2, 0.0, 0.0]))
    grip = grip.translate(jnp.stack([0.26 * wide[0], 0.0, 0.1 * wide[6]]))
    return body.blend(neck, 0.06 + 0.02 * u[7]).blend(grip, 0.03)


@jax.jit
def surface(u, key):
    """Points [c, 3] on a flask, and their normals."""
    field = flask(u)
    box = jnp.array([0.5, 0.3, 0.65])
    points = box * jax.random.uniform(key, (CANDIDATES, 3), minval=-1.0, maxval=1.0)
    gradient = jax.vmap(jax.value_and_grad(field))

    def step(points, _):
        value, slope = gradient(points)
        square = jnp.sum(slope**2, axis=1)
        # Far from any crease one step arrives; near one the steps must be short.
        return points - (value / jnp.maximum(square, 0.25))[:, None] * slope, None

    points, _ = jax.lax.scan(step, points, length=8)
    value, normals = gradient(points)
    return points, normals, jnp.abs(value) < 1e-4


def view(rng, index):
    """Points of a flask seen from one side."""
    u = rng.uniform(-1, 1, NUMBERS).astype(np.float32)
    points, normals, found = map(np.asarray, surface(u, jax.random.key(index)))
    toward = rng.normal(size=3)
    seen = points[found & (normals @ toward > 0)]
    return seen[: rng.integers(SMALLEST, LARGEST)]


def offset(rng):
    """A motion [4, 4] by 20 degrees and a tenth of the height."""
    axis, way = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.radians(DEGREES) * axis).as_matrix()
    return np.vstack([np.column_stack([turn, DISTANCE * way]), [0, 0, 0, 1]])


def make(folder, scans):
    """Scans, template, manifest and true poses (host)."""
    folder.mkdir(parents=True, exist_ok=True)
    rng, poses = np.random.default_rng(1), []
    points, _, found = map(np.asarray, surface(np.zeros(NUMBERS), jax.random.key(0)))
    np.save(folder / "template.npy", points[found][:TEMPLATE])
    with open(folder / "manifest.csv", "w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["id", "source", "target"])
        for i in range(scans):
            moved = offset(rng)
            scan = view(rng, i + 1)
            scan = scan + NOISE * rng.normal(size=scan.shape)
            np.save(folder / f"{i}.npy", scan @ moved[:3, :3].T + moved[:3, 3])
            poses.append(np.linalg.inv(moved))
            rows.writerow([i, folder / f"{i}.npy", folder / "template.npy"])
    np.save(folder / "poses.npy", poses)


def errors(found, truth):
    """Degrees, and how far the origin of the template is off, of many poses."""
    apart = np.asarray(found) @ np.linalg.inv(truth)
    angle = Rotation.from_matrix(apart[:, :3, :3]).magnitude()
    return np.degrees(angle), np.linalg.norm(apart[:, :3, 3], axis=1)


def told(found, truth):
    """The errors in words."""
    angle, apart = errors(found, truth)
    return (
        f"median {np.median(angle):.2f} deg, {np.median(apart):.4f}; "
        f"within 5 deg {100 * np.mean(angle < 5):.1f} %"
    )


def ours(folder):
    """One run of the batch; prints its clock and memory as JSON (own process)."""
    start, marks = time.perf_counter(), []

    def tell(text):
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        marks.append((time.perf_counter() - start, text, used))

    tally = run_batch(folder / "manifest.csv", folder / "out", tell=tell)
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    end = time.perf_counter() - start
    print(json.dumps({"tally": tally, "marks": marks, "seconds": end, "mib": used}))


def show_ours(folder, truth):
    """Run ours in a process of its own, and say what it did."""
    command = [sys.executable, __file__, str(folder), "--ours"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    facts = json.loads(done.stdout.splitlines()[-1])
    print(f"ours: {facts['tally']} in {facts['seconds']:.1f} s, {facts['mib']:.0f} MiB")
    chunks = [m for m in facts["marks"] if " at once" in m[1]]
    ends = [m[0] for m in chunks[1:]] + [facts["seconds"]]
    seen, compiling, work, count = set(), 0.0, 0.0, 0
    for (begin, text, _), stop in zip(chunks, ends, strict=True):
        number, kind = text.split(" scans ")
        if kind in seen:
            work, count = work + stop - begin, count + int(number)
        else:
            compiling, _ = compiling + stop - begin, seen.add(kind)
    print(f"  {len(seen)} programs, their first calls {compiling:.1f} s")
    print(f"  {count / work:.0f} scans a second after that")
    tenths = [m[2] for m in chunks[:: max(1, len(chunks) // 10)]]
    print("  MiB so far:", *(f"{x:.0f}" for x in tenths))
    states = (json.loads(p.read_text()) for p in (folder / "out").rglob("*/*/*.json"))
    table = {int(s["id"]): s["transform"] for s in states if s["transform"]}
    ids = sorted(table)
    print("  " + told([table[i] for i in ids], truth[ids]), flush=True)
    return count / work


def by_gicp(kind, threads, template):
    """A function that aligns a scan by small_gicp."""
    there = small_gicp.PointCloud(template)
    tree = small_gicp.KdTree(there, num_threads=threads)
    normals = functools.partial(
        small_gicp.estimate_normals_covariances, num_neighbors=12, num_threads=threads
    )
    normals(there, tree)

    def run(source):
        here = small_gicp.PointCloud(source)
        if kind == "GICP":
            normals(here, small_gicp.KdTree(here, num_threads=threads))
        found = small_gicp.align(
            *(there, here, tree, np.eye(4)),
            registration_type=kind,
            max_correspondence_distance=GATE,
            num_threads=threads,
            max_iterations=MOST_STEPS,
        )
        return found.T_target_source

    return run


def by_open3d(template):
    """A function that aligns a scan by Open3D, point to plane with a Tukey kernel."""
    there = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(template))
    there.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(12))
    rules = open3d.pipelines.registration

    def run(source):
        here = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(source))
        found = rules.registration_icp(
            *(here, there, GATE, np.eye(4)),
            rules.TransformationEstimationPointToPlane(rules.TukeyLoss(k=GATE / 3)),
            rules.ICPConvergenceCriteria(max_iteration=MOST_STEPS),
        )
        return found.transformation

    return run


def peers(template):
    """The peers that are installed, by name."""
    out = {}
    if small_gicp is not None:
        out["small_gicp plane, 2 threads"] = by_gicp("PLANE_ICP", 2, template)
        out["small_gicp gicp, 2 threads"] = by_gicp("GICP", 2, template)
    if open3d is not None:
        out["open3d plane, Tukey"] = by_open3d(template)
    return out


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--scans", type=int, default=10_000)
    parser.add_argument("--peers", type=int, default=1_000)
    parser.add_argument("--ours", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.ours:
        return ours(args.folder)
    if not (args.folder / "poses.npy").exists():
        make(args.folder, args.scans)
    truth = np.load(args.folder / "poses.npy")
    rate = show_ours(args.folder, truth)
    template = np.load(args.folder / "template.npy")
    ids = np.arange(0, len(truth), max(1, len(truth) // args.peers))
    for name, run in peers(template).items():
        start = time.perf_counter()
        found = [run(np.load(args.folder / f"{i}.npy")) for i in ids]
        speed = len(ids) / (time.perf_counter() - start)
        print(f"{name}: {speed:.0f} scans a second, ours {rate / speed:.2f} times that")
        print("  " + told(found, truth[ids]), flush=True)


if __name__ == "__main__":
    main()
