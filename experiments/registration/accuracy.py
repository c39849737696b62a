"""How near registrations of real scans come to the published poses.

    JAXGEOM_DATA=... python experiments/registration/accuracy.py [case ...]

Cases: bunny, basin, pairs, lidar, fricp, halves, covariance. Prints rotation in degrees
and the displacement of the centroid of the source, beside what is asked for. The pairs
are all 23 overlapping pairs of raw bunny scans in one compiled ragged call.
"""

import argparse
import os
import pathlib
import time

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from jaxgeom import PointCloud, Rigid, stack
from jaxgeom.pipelines import MeanAligned, Pyramid, register, register_many

DATA = pathlib.Path(os.environ.get("JAXGEOM_DATA", ".")) / "registration"
# target source floor in degrees, in mm
PAIRS = """000 045 .084 .07|000 090 .058 .29|000 270 .376 .44|000 top3 .133 .33
000 315 .038 .15|000 chin .079 .18|045 090 .024 .25|045 top3 .087 .24
045 315 .124 .33|045 chin .120 .31|090 180 .415 .15|090 top2 .272 .31
090 top3 .077 .31|090 ear_back .174 .28|180 270 .298 .62|180 top2 .066 .16
180 ear_back .149 .14|270 315 .213 .42|270 chin .379 .66|top2 top3 .194 .33
top2 ear_back .082 .40|top3 315 .319 .81|315 chin .142 .29"""


def scans():
    """The raw bunny scans by name."""
    table = np.load(DATA / "stanford_bunny/bunny_scans.npz")
    return {k[:-4]: table[k] for k in table if k.endswith("_xyz")}


def poses():
    """world_from_scan [4, 4] of every scan of bun.conf."""
    found = {}
    for line in (DATA / "stanford_bunny/bun.conf").read_text().splitlines():
        if line.startswith("bmesh"):
            _, name, *numbers = line.split()
            values = np.array(numbers, float)
            # The published quaternions turn the other way.
            turn = Rotation.from_quat(values[3:]).as_matrix().T
            found[name.removesuffix(".ply")] = matrix(turn, values[:3])
    return found


def matrix(turn, shift):
    """[[R, t], [0, 1]]."""
    return np.vstack([np.column_stack([turn, shift]), [0, 0, 0, 1]])


def relative(target, source):
    """target_from_source of two published poses."""
    table = poses()
    return np.linalg.inv(table[target]) @ table[source]


def errors(transform, truth, source):
    """Degrees, and the displacement of the centroid of the source."""
    turn = np.asarray(transform.rotation, float)
    off = Rotation.from_matrix(turn @ truth[:3, :3].T).magnitude()
    center = source.mean(axis=0).astype(float)
    there = turn @ center + np.asarray(transform.translation, float)
    return np.degrees(off), np.linalg.norm(
        there - truth[:3, :3] @ center - truth[:3, 3]
    )


def vertices(path):
    """The points of a file."""
    return np.asarray(trimesh.load(path, process=False).vertices)


def as_rigid(table):
    """A matrix [4, 4] as a transform."""
    return Rigid(table[:3, :3], table[:3, 3])


def report(name, found, truth, source, wanted, unit=1e3):
    """One row."""
    turn, shift = errors(found.target_from_source, truth, source)
    print(
        f"{name:12} {turn:.4f} deg {unit * shift:.4f}   (asked: {wanted})   "
        f"steps {int(found.num_steps)}, fitness {float(found.fitness):.3f}, "
        f"status {int(found.result._value)}"
    )
    return turn, shift


def bunny():
    """The mean-aligned start, 34 degrees away."""
    table = scans()
    source, target = table["bun045"], table["bun000"]
    found = register(source, target, init=MeanAligned(), throw=False)
    report("bunny", found, relative("bun000", "bun045"), source, "0.085, 0.075 mm")


def turned(truth, axis, degrees, shift, center):
    """The true pose, turned about the center of the source and shifted."""
    turn = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix() @ truth[:3, :3]
    there = truth[:3, :3] @ center + truth[:3, 3] + shift
    return matrix(turn, there - turn @ center)


def directions(count, seed):
    """Random unit vectors."""
    x = np.random.default_rng(seed).normal(size=(count, 3))
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def basin():
    """12 axes an angle, 5 mm off; success is below 1 degree and 1 mm."""
    table, truth = scans(), relative("bun000", "bun045")
    source, target = table["bun045"], table["bun000"]
    center = source.mean(axis=0).astype(float)
    axes, shifts = directions(12, 0), 0.005 * directions(12, 1)
    for degrees, wanted in ((20, 12), (40, 12), (60, 8), (80, "-")):
        good = []
        for axis, shift in zip(axes, shifts, strict=True):
            init = as_rigid(turned(truth, axis, degrees, shift, center))
            found = register(source, target, init=init, voxel_size=1e-3, throw=False)
            turn, off = errors(found.target_from_source, truth, source)
            good.append((turn < 1) & (off < 1e-3))
        print(f"basin {degrees:3} deg  {sum(good)}/12   (asked: {wanted})")


def pairs():
    """All overlapping pairs, 10 degrees and 5 mm off, in one call."""
    table = scans()
    full = lambda short: f"bun{short}" if short.isdigit() else short
    rows = [row.split() for row in PAIRS.replace("\n", "|").split("|")]
    names = [(full(t), full(s)) for t, s, *_ in rows]
    truth = [relative(*pair) for pair in names]
    axes, shifts = directions(len(rows), 2), 0.005 * directions(len(rows), 3)
    starts = [
        as_rigid(turned(m, a, 10, d, table[s].mean(axis=0).astype(float)))
        for (_, s), m, a, d in zip(names, truth, axes, shifts, strict=True)
    ]
    begin = time.perf_counter()
    found = register_many(
        stack([PointCloud(table[s]) for _, s in names]),
        stack([PointCloud(table[t]) for t, _ in names]),
        init=jax.tree.map(lambda *x: np.stack(x), *starts),
    )
    jax.block_until_ready(found.rmse)
    inside = 0
    for i, ((t, s), row) in enumerate(zip(names, rows, strict=True)):
        one = jax.tree.map(lambda x, i=i: x[i], found)
        floor = [float(x) for x in row[2:]]
        wanted = "{:.3f}, {:.2f} mm".format(*(1.5 * x for x in floor))
        turn, off = report(f"{t[-4:]}<-{s[-4:]}", one, truth[i], table[s], wanted)
        inside += turn <= 1.5 * floor[0] and 1e3 * off <= 1.5 * floor[1]
    seconds = time.perf_counter() - begin
    print(f"pairs within 1.5 floors: {inside}/{len(rows)} ({seconds:.0f} s in all)")


def lidar():
    """From the identity."""
    folder = DATA / "small_gicp"
    source, target = (vertices(folder / f"{n}.ply") for n in ("source", "target"))
    truth = np.loadtxt(folder / "T_target_source.txt")
    found = register(source, target, throw=False)
    report("lidar", found, truth, source, "0.21, 1 cm", 1e2)


def fricp():
    """From the mean-aligned start."""
    folder = DATA / "fricp"
    source, target = (vertices(folder / f"{n}.ply") for n in ("source", "target"))
    truth = np.loadtxt(folder / "m3trans.txt")
    for name, pyramid in (
        ("fricp", Pyramid()),
        ("fricp, all", Pyramid((4.0, 2.0, 1.0, 0.0), (30.0, 10.0, 4.0, 2.0))),
    ):
        found = register(
            source, target, init=MeanAligned(), pyramid=pyramid, throw=False
        )
        report(name, found, truth, source, "0.01 deg", 1)


def halves():
    """Odd and even columns of one scan, one half moved by a known pose."""
    table = np.load(DATA / "stanford_bunny/bunny_scans.npz")
    points, grid = table["bun000_xyz"], table["bun000_grid"]
    even, odd = (grid[:, i::2] for i in (0, 1))
    target, source = (points[half[half >= 0]] for half in (even, odd))
    move = Rigid.exp(jnp.asarray([0.1, -0.12, 0.07, 0.004, -0.003, 0.002]))
    there = move(source)
    found = register(np.asarray(there), target, throw=False)
    truth = np.linalg.inv(np.asarray(move.matrix(), float))
    report("halves", found, truth, np.asarray(there), "0.05 mm (1/10 of the spacing)")


CASES = dict(
    bunny=bunny, lidar=lidar, fricp=fricp, halves=halves, basin=basin, pairs=pairs
)


def main():
    """The table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cases", nargs="*", default=list(CASES))
    for case in parser.parse_args().cases:
        CASES[case]()


if __name__ == "__main__":
    main()
