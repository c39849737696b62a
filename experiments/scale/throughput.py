"""How many scans a second `jaxgeom batch` aligns, beside loops over peers.

    python -m experiments.scale.throughput FOLDER [--scans 10000] [--peers 1000]

Flasks of a family of fields (8 numbers each), seen from one side, 500 to 5 000 points,
noise of 0.2 % of the height, turned by 20 degrees and moved by 0.1 (they are 0.9 high),
are laid on the mean flask. Scans and manifest are written to FOLDER first. Ours is one
`run_batch` of all of them, files and states included, in a process of its own; the
peers read the same files in a loop, every k-th of them, with normals and trees of the
template made once. small_gicp stops at steps as small as ours (`TOLERANCE`), Open3D at
its own default, relative changes of 1e-6. Errors are those of the pose in the frame of
the template; since flasks differ, no method reaches zero. Prints the rate without the
first chunk of each size, which compiles, how long these took, and the largest memory so
far as the run goes on. Run it from the root of the repository.
"""

import argparse
import csv
import json
import os
import pathlib
import resource
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from experiments.registration import speed
from jaxgeom.batch import run_batch
from jaxgeom.fields import Box, Cylinder, Torus
from jaxgeom.transforms import rotation_exp

NUMBERS, CANDIDATES, SMALLEST, LARGEST, TEMPLATE = 8, 12_000, 500, 5_000, 2_000
NOISE, DEGREES, DISTANCE, GATE, THREADS = 0.002, 20.0, 0.1, 0.15, 2
# Of `icp` in single precision: radians, and sizes of the target (0.36 here).
TOLERANCE = float(np.finfo(np.float32).eps ** (2 / 3))


def flask(u):
    """The flask with parameters u [8] in [-1, 1]: about 0.9 high."""
    wide = 1 + 0.08 * u
    body = Box(jnp.stack([0.2 * wide[0], 0.12 * wide[1], 0.28 * wide[2]])).rounded(0.05)
    neck = Cylinder(0.06 * wide[3], 0.15, (0.05, 0.0, 0.4))
    grip = Torus(0.13 * wide[4], 0.03 * wide[5])
    grip = grip.rotate(rotation_exp(jnp.array([jnp.pi / 2, 0.0, 0.0])))
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
            moved = speed.offset(np.eye(4), np.zeros(3), rng, DEGREES, DISTANCE)
            scan = view(rng, i + 1)
            scan = scan + NOISE * rng.normal(size=scan.shape)
            np.save(folder / f"{i}.npy", scan @ moved[:3, :3].T + moved[:3, 3])
            poses.append(np.linalg.inv(moved))
            rows.writerow([i, folder / f"{i}.npy", folder / "template.npy"])
    np.save(folder / "poses.npy", poses)


def told(found, truth):
    """The errors in words."""
    pairs = zip(np.asarray(found), truth, strict=True)
    angle, apart = np.transpose([speed.errors(*pair, np.zeros(3)) for pair in pairs])
    return (
        f"median {np.median(angle):.2f} deg, {np.median(apart):.4f}; "
        f"within 5 deg {100 * np.mean(angle < 5):.1f} %"
    )


def ours(folder):
    """One run of the batch; prints its clock and memory as JSON (own process)."""
    # As `jaxgeom batch` does.
    jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))
    start, marks = time.perf_counter(), []
    used = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    tell = lambda text: marks.append((time.perf_counter() - start, text, used()))
    facts = {"marks": marks, "before": used()}
    facts["tally"] = run_batch(folder / "manifest.csv", folder / "out", tell=tell)
    print(json.dumps({**facts, "seconds": time.perf_counter() - start, "mib": used()}))


def rate_of(chunks, end):
    """Scans a second after the first chunk of each size, how many sizes there were, and
    the seconds of those first chunks; `chunks` are when each began, and its line."""
    seen, compiling, work, count = set(), 0.0, 0.0, 0
    stops = [*(chunk[0] for chunk in chunks[1:]), end]
    for (begin, text, *_), stop in zip(chunks, stops, strict=True):
        number, kind = text.split(" scans ")
        if kind in seen:
            work, count = work + stop - begin, count + int(number)
        else:
            compiling += stop - begin
            seen.add(kind)
    return count / work, len(seen), compiling


def show_ours(folder, truth):
    """Run ours in a process of its own, and say what it did."""
    command = [sys.executable, "-m", "experiments.scale.throughput"]
    command += [str(folder), "--ours"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    facts = json.loads(done.stdout.splitlines()[-1])
    print(f"ours: {facts['tally']} in {facts['seconds']:.1f} s, {facts['mib']:.0f} MiB")
    chunks = [m for m in facts["marks"] if " at once" in m[1]]
    rate, programs, compiling = rate_of(chunks, facts["seconds"])
    print(f"  {programs} programs, their first calls {compiling:.1f} s")
    print(f"  {rate:.0f} scans a second after that")
    tenths = [m[2] for m in chunks[:: max(1, len(chunks) // 10)]]
    print(f"  MiB: {facts['before']:.0f} before,", *(f"{x:.0f}" for x in tenths))
    states = (json.loads(p.read_text()) for p in (folder / "out").rglob("*/*/*.json"))
    table = {int(s["id"]): s["transform"] for s in states if s["transform"]}
    ids = sorted(table)
    print("  " + told([table[i] for i in ids], truth[ids]), flush=True)
    return rate


def by_gicp(kind, template):
    """A function that aligns a scan by small_gicp."""
    there = speed.gicp_side(template, THREADS)
    settings = {
        "registration_type": kind,
        "num_threads": THREADS,
        "rotation_epsilon": TOLERANCE,
        "translation_epsilon": 0.36 * TOLERANCE,
    }

    def run(source):
        bare = speed.small_gicp.PointCloud
        plane = kind == "PLANE_ICP"
        here = bare(source) if plane else speed.gicp_side(source, THREADS)[0]
        return speed.gicp_aligned(here, there, np.eye(4), GATE, **settings)

    return run


def by_open3d(template):
    """A function that aligns a scan by Open3D, point to plane with a Tukey kernel."""
    there = speed.open3d_side(template)
    kernel = speed.open3d.pipelines.registration.TukeyLoss(k=GATE / 3)

    def run(source):
        here = speed.open3d_side(source, normals=False)
        return speed.open3d_aligned(here, there, np.eye(4), GATE, kernel)

    return run


def peers(template):
    """The peers that are installed, by name."""
    out = {}
    if speed.small_gicp is not None:
        out["small_gicp plane, 2 threads"] = by_gicp("PLANE_ICP", template)
        out["small_gicp gicp, 2 threads"] = by_gicp("GICP", template)
    if speed.open3d is not None:
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
