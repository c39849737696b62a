"""Bunny scan pairs aligned with no pose given, from features alone.

    JAXGEOM_DATA=... python experiments/registration/global_start.py

Prints, for the pairs of raw scans that overlap by at least half, the rotation and
translation error against the published pose, the number of matches and of those that
agree, the fitness, the status and the time of a compiled call on one scan pair; then
how many pairs land within 5 degrees and 5 mm. Translation is compared at the center of
the source scan. Normals come from 16 neighbors and face the scanner (+z).
"""

import argparse
import os
import pathlib
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from jaxgeom import PointCloud, Rigid, stack
from jaxgeom.normals import estimate, orient_toward_viewpoint
from jaxgeom.registration import align_features

PAIRS = """000 045 .90|000 090 .49|000 270 .38|000 top3 .65|000 315 .79|000 chin .50
045 090 .64|045 top3 .72|045 315 .59|045 chin .40|090 180 .36|090 top2 .48|090 top3 .57
090 ear_back .56|180 270 .52|180 top2 .78|180 ear_back .89|270 315 .60|270 chin .39
top2 top3 .50|top2 ear_back .79|top3 315 .38|315 chin .57"""
CAPACITY = 41_000


def poses(folder):
    """world_from_scan of every scan of bun.conf."""
    found = {}
    for line in (folder / "bun.conf").read_text().splitlines():
        if line.startswith("bmesh"):
            _, name, *numbers = line.split()
            values = np.array(numbers, float)
            # The published quaternions turn the other way.
            turn = Rotation.from_quat(values[3:]).as_matrix().T
            found[name.removesuffix(".ply")] = (turn, values[:3])
    return found


@jax.jit
def oriented(cloud):
    """The scan with normals that face the scanner."""
    far = jnp.asarray([0.0, 0.0, 10.0], cloud.points.dtype)
    return orient_toward_viewpoint(estimate(cloud, k=16), far)


def full_name(short):
    """bun045 for 045."""
    return f"bun{short}" if short.isdigit() else short


def main():
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--voxel-size", type=float, default=0.004)
    parser.add_argument("--overlap", type=float, default=0.5)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument(
        "--only", type=int, default=None, help="the first so many pairs"
    )
    args = parser.parse_args()
    folder = pathlib.Path(os.environ["JAXGEOM_DATA"]) / "registration/stanford_bunny"
    scans = np.load(folder / "bunny_scans.npz")
    truth = poses(folder)
    clouds = {}
    for name in truth:
        padded = stack([PointCloud(scans[f"{name}_xyz"])], capacity=CAPACITY)
        clouds[name] = oriented(jax.tree.map(lambda x: x[0], padded))
    align = jax.jit(
        lambda s, t, key: align_features(s, t, voxel_size=args.voxel_size, key=key)
    )
    landed = total = 0
    rows = [row.split() for row in PAIRS.replace("\n", "|").split("|")]
    rows = [row for row in rows if float(row[2]) >= args.overlap][: args.only]
    for a, b, overlap in rows:
        target, source = full_name(a), full_name(b)
        (rt, tt), (rs, ts) = truth[target], truth[source]
        true = Rigid(rt.T @ rs, rt.T @ (ts - tt))
        center = scans[f"{source}_xyz"].mean(axis=0)
        for seed in range(args.seeds):
            begin = time.perf_counter()
            key = jax.random.key(seed)
            found = jax.block_until_ready(align(clouds[source], clouds[target], key))
            took = time.perf_counter() - begin
            move = found.target_from_source
            turn = Rotation.from_matrix(np.asarray(move.rotation) @ true.rotation.T)
            degrees = np.degrees(turn.magnitude())
            off = 1e3 * np.linalg.norm(move(center) - true(center))
            good = degrees < 5 and off < 5
            landed, total = landed + good, total + 1
            print(
                f"{target:>8} <- {source:<8} overlap {overlap} {degrees:8.2f} deg "
                f"{off:7.2f} mm  matches {int(found.num_matches):4d} "
                f"inliers {int(found.num_inliers):4d} fitness {found.fitness:.2f} "
                f"rmse {1e3 * found.rmse:.2f} mm status {int(found.result._value)} "
                f"{took:6.2f} s {'' if good else '  MISSED'}",
                flush=True,
            )
    print(f"{landed} of {total} within 5 degrees and 5 mm")


if __name__ == "__main__":
    main()
