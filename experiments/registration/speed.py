"""How fast scans are aligned beside small_gicp and Open3D (CPU), all steps included.

    JAXGEOM_DATA=... python experiments/registration/speed.py [--cases 10k 40k many ...]

A pair is bunny 045 on 000, started 10 degrees and 5 mm off, gate 5 mm: the raw scans
(40k points each) or 10k points drawn from them. A batch is 64 ragged draws of about 2
000 points of the raw scans, each turned by 10 degrees and moved by 5 mm from another
draw of its own scan, aligned with it in one call. Every time holds search structures,
normals of both sides and all iterations. Ours uses one CPU device for each core, which
share the normals of a pair, or a batch; and one alone; and aligns all points at once,
or first a few. Ours and the peers take turns;
prints medians in ms of wall time and of CPU time of the process, errors in degrees and
mm, the time to compile, and ratios. The gradient is that of a sum of the pose's numbers
with respect to the points of both sides. Peers that are not installed are left out.
"""

import argparse
import os
import pathlib
import time
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from scipy.spatial.transform import Rotation

from jaxgeom import PointCloud, Rigid, stack
from jaxgeom.neighbors import AbstractBackend, HostTree, KdTree
from jaxgeom.normals import estimate
from jaxgeom.pipelines import register
from jaxgeom.pipelines._devices import on_each, placed
from jaxgeom.registration import Method, Nearest, icp, prepare_target

try:
    import small_gicp
except ImportError:
    small_gicp = None
try:
    import open3d
except ImportError:
    open3d = None

DATA = pathlib.Path(os.environ.get("JAXGEOM_DATA", ".")) / "registration"
GATE, NEIGHBORS, MOST_STEPS, THREADS = 5.0, 12, 50, 2
# How many points are aligned first, and when they are near enough: radians, and sizes
# of the target.
FIRST, COARSE = 400, 1e-3
# As many as the peers have threads; a single pair uses the first one only.
jax.config.update("jax_num_cpu_devices", THREADS)


def scans():
    """The raw bunny scans by name, in mm."""
    table = np.load(DATA / "stanford_bunny/bunny_scans.npz")
    return {k[:-4]: 1e3 * table[k] for k in table if k.endswith("_xyz")}


def pose(name):
    """world_from_scan [4, 4] of bun.conf, in mm."""
    for line in (DATA / "stanford_bunny/bun.conf").read_text().splitlines():
        if line.startswith("bmesh") and line.split()[1] == f"{name}.ply":
            values = np.array(line.split()[2:], float)
            # The published quaternions turn the other way.
            turn = Rotation.from_quat(values[3:]).as_matrix().T
            return matrix(turn, 1e3 * values[:3])
    raise KeyError(name)


def matrix(turn, shift):
    """[[R, t], [0, 1]]."""
    return np.vstack([np.column_stack([turn, shift]), [0, 0, 0, 1]])


def offset(truth, center, rng, degrees=10.0, distance=5.0):
    """The pose `truth`, turned about the moved `center` and shifted at random."""
    axis, way = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    middle = truth[:3, :3] @ center + truth[:3, 3]
    return matrix(turn, middle - turn @ middle + distance * way) @ truth


def errors(found, truth, center):
    """Degrees, and how far the center of the source is off."""
    angle = Rotation.from_matrix(found[:3, :3] @ truth[:3, :3].T).magnitude()
    apart = (found - truth)[:3, :3] @ center + (found - truth)[:3, 3]
    return np.degrees(angle), np.linalg.norm(apart)


def pair_case(size):
    """Source, target, start and truth."""
    rng = np.random.default_rng(3)
    table = scans()
    truth = np.linalg.inv(pose("bun000")) @ pose("bun045")
    source, target = table["bun045"], table["bun000"]
    if size is not None:
        draw = lambda x: x[rng.permutation(len(x))[:size]]
        source, target = draw(source), draw(target)
    return source, target, offset(truth, source.mean(axis=0), rng), truth


def batch_case(count, size):
    """Such pairs of ragged draws of one scan each, the sources moved."""
    rng = np.random.default_rng(5)
    table = list(scans().values())
    out = []
    for i in range(count):
        scan = table[i % len(table)]
        numbers = rng.integers(9 * size // 10, 11 * size // 10, 2)
        source, target = (scan[rng.permutation(len(scan))[:n]] for n in numbers)
        center = source.mean(axis=0)
        moved = offset(np.eye(4), center, rng)
        source = source @ moved[:3, :3].T + moved[:3, 3]
        out.append((source, target, np.eye(4), np.linalg.inv(moved)))
    return out


def prepared(points):
    """A cloud in single precision, on the device."""
    return PointCloud(jnp.asarray(points, jnp.float32))


class Ours(eqx.Module):
    """Normals of both sides, then `icp`: first of about so many points of the source,
    if any, and then of all.

    The normals of both sides are one program called twice: within one program XLA on
    the CPU may run two independent loops at once, and then wait forever for threads
    that wait for each other.
    """

    neighbors: AbstractBackend
    first: int | None = eqx.field(static=True, default=None)

    @property
    def method(self):
        return Method(correspondence=Nearest(backend=self.neighbors))

    @eqx.filter_jit
    def prepared(self, cloud):
        """A cloud as a target, with normals by the same search structure."""
        target = prepare_target(cloud, self.method.correspondence)
        there = estimate(target.cloud, k=NEIGHBORS, index=target.index)
        return target.with_normals(there.normals)

    @eqx.filter_jit
    def aligned(self, source, target, start, gate):
        settings = dict(method=self.method, max_distance=gate, max_steps=MOST_STEPS)
        if self.first is not None:
            skip = max(len(source.points) // self.first, 1)
            few = jax.tree.map(lambda x: x[::skip], source)
            found = icp(few, target, init=start, rtol=COARSE, **settings)
            start = found.target_from_source
        return icp(source, target, init=start, **settings)

    def align(self, source, target, start, gate):
        """One alignment from bare points."""
        normals = self.prepared(source).cloud.normals
        return self.aligned(
            source.with_normals(normals), self.prepared(target), start, gate
        )

    @eqx.filter_jit
    def align_on_two(self, source, target, start, gate, mesh):
        """The same by two devices that share the normals of the target; then one
        aligns, and the other finds the normals of the source: what each has found."""
        (axis,) = mesh.axis_names

        def run(source, target, start, gate):
            there = prepare_target(target, self.method.correspondence)
            shared = dict(index=there.index, axis=axis)
            normals = estimate(there.cloud, k=NEIGHBORS, **shared).normals
            tasks = (
                lambda: self.aligned(source, there.with_normals(normals), start, gate),
                lambda: estimate(source, k=NEIGHBORS).normals,
            )
            out = taken_by_one(tasks, jax.lax.axis_index(axis))
            return jax.tree.map(lambda x: x[None], out)

        each = jax.shard_map(
            run, mesh=mesh, in_specs=P(), out_specs=P(axis), check_vma=False
        )
        found, normals = each(source, target, start, gate)
        return jax.tree.map(lambda x: x[0], found), normals[1]

    @eqx.filter_jit
    def align_all(self, items, gate, mesh):
        """All alignments of a batch of (source, target, start) in one program, each
        device of the mesh one after the other."""
        run = lambda items, gate: jax.lax.map(lambda i: self.align(*i, gate), items)
        return on_each(run, mesh)(items, gate)


def taken_by_one(tasks, number):
    """What each task gives, where it is that of this number; otherwise zeros."""
    shapes = [jax.eval_shape(task) for task in tasks]
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def only(i):
        return lambda: [tasks[i]() if i == j else b for j, b in enumerate(blank)]

    return jax.lax.switch(number, [only(i) for i in range(len(tasks))])


OURS = {
    "icp, few first": Ours(KdTree(), FIRST),
    "icp": Ours(KdTree()),
    "icp, host tree": Ours(HostTree()),
}


def rigid(table):
    """Matrices [..., 4, 4] as a transform in single precision."""
    table = np.asarray(table, np.float32)
    return Rigid(jnp.asarray(table[..., :3, :3]), jnp.asarray(table[..., :3, 3]))


def table_of(transform):
    """A transform as a matrix."""
    turn, shift = np.asarray(transform.rotation), np.asarray(transform.translation)
    return matrix(turn.astype(float), shift.astype(float))


def gicp_side(points, threads):
    """A cloud of small_gicp with normals, and its tree."""
    cloud = small_gicp.PointCloud(points)
    tree = small_gicp.KdTree(cloud, num_threads=threads)
    small_gicp.estimate_normals_covariances(
        cloud, tree, num_neighbors=NEIGHBORS, num_threads=threads
    )
    return cloud, tree


def gicp_aligned(source, target_side, start, gate, **settings):
    """The pose of a cloud on a side of small_gicp."""
    found = small_gicp.align(
        *(target_side[0], source, target_side[1], start),
        max_correspondence_distance=gate,
        max_iterations=MOST_STEPS,
        **settings,
    )
    return found.T_target_source


def by_gicp(kind, threads):
    """A function that aligns a pair by small_gicp."""
    settings = {"registration_type": kind, "num_threads": threads}

    def run(source, target, start, _):
        there, here = (gicp_side(x, threads) for x in (target, source))
        return gicp_aligned(here[0], there, start, GATE, **settings)

    return run


def open3d_side(points, normals=True):
    """A cloud of Open3D, with normals or without."""
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    if normals:
        cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(NEIGHBORS))
    return cloud


def open3d_aligned(source, target, start, gate, *kernel):
    """The pose of clouds of Open3D, point to plane."""
    rules = open3d.pipelines.registration
    found = rules.registration_icp(
        *(source, target, gate, start),
        rules.TransformationEstimationPointToPlane(*kernel),
        rules.ICPConvergenceCriteria(max_iteration=MOST_STEPS),
    )
    return found.transformation


def by_open3d(source, target, start, _):
    """The pose by Open3D, point to plane."""
    return open3d_aligned(*map(open3d_side, (source, target)), start, GATE)


def peers():
    """The peers that are installed, by name."""
    out = {}
    if small_gicp is not None:
        out["gicp plane, 2 threads"] = by_gicp("PLANE_ICP", THREADS)
        out["gicp gicp, 2 threads"] = by_gicp("GICP", THREADS)
    if open3d is not None:
        out["open3d plane"] = by_open3d
    return out


def clock(runs, repeats):
    """Name -> median wall and CPU seconds, the runs taking turns."""
    times = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            # Threads of another may still wait for work, and keep a core.
            run()
            wall, work = time.perf_counter(), time.process_time()
            run()
            stop = time.perf_counter(), time.process_time()
            times[name].append((stop[0] - wall, stop[1] - work))
    return {name: np.median(t, axis=0) for name, t in times.items()}


def first(name, run):
    """The first call, which compiles: its result, and how long it took."""
    start = time.perf_counter()
    result = jax.block_until_ready(run())
    print(f"  {name}: first call {time.perf_counter() - start:.1f} s", flush=True)
    return result


def show(times, notes):
    """One row a method, with the ratio of the first to it."""
    ours = next(iter(times.values()))
    for name, (wall, work) in times.items():
        print(
            f"  {name:24}{1e3 * wall:9.1f} ms wall{1e3 * work:9.1f} cpu   ratio "
            f"{ours[0] / wall:5.2f} wall {ours[1] / work:5.2f} cpu   {notes[name]}",
            flush=True,
        )


def note(found, truth, center):
    """The errors in words."""
    return "{:.4f} deg {:.4f} mm".format(*errors(found, truth, center))


def one_pair(label, size, repeats, door):
    """The table of one pair."""
    source, target, start, truth = pair_case(size)
    print(f"{label}: {len(source)} on {len(target)}")
    arguments = (prepared(source), prepared(target), rigid(start), jnp.float32(GATE))
    call = lambda ours: jax.block_until_ready(ours.align(*arguments))
    runs, two = {}, jax.devices()[:2]
    if len(two) > 1:
        mesh = Mesh(np.asarray(two), ("device",))
        given = jax.device_put(arguments, NamedSharding(mesh, P()))
        on_two = lambda ours: jax.block_until_ready(ours.align_on_two(*given, mesh))[0]
        runs = {name: partial(on_two, OURS[name]) for name in ("icp, few first", "icp")}
    for name, ours in OURS.items():
        runs[f"{name}, one device"] = partial(call, ours)
    center = source.mean(axis=0)
    told = lambda f: (
        note(table_of(f.target_from_source), truth, center)
        + f", {int(f.num_steps)} steps, status {int(f.result._value)}"
    )
    notes = {name: told(first(name, run)) for name, run in runs.items()}
    if door:
        init = Rigid(start[:3, :3], start[:3, 3])
        runs["register"] = lambda: register(source, target, init=init, throw=False)
        notes["register"] = told(first("register", runs["register"]))
    for name, peer in peers().items():
        runs[name] = lambda peer=peer: peer(source, target, start, None)
        notes[name] = note(runs[name](), truth, center)
    show(clock(runs, repeats), notes)


def gradient(label, size, repeats):
    """An alignment with its derivative beside the alignment alone."""
    source, target, start, _ = pair_case(size)
    oriented = lambda c: c.with_normals(OURS["icp"].prepared(c).cloud.normals)
    here, there = (oriented(prepared(x)) for x in (source, target))
    arguments = (here, there, rigid(start), jnp.float32(GATE))

    def value(points, here, there, start, gate):
        swap = lambda c, p: eqx.tree_at(lambda c: c.points, c, p)
        clouds = [swap(c, p) for c, p in zip((here, there), points, strict=True)]
        moved = icp(*clouds, init=start, max_distance=gate).target_from_source
        return jnp.sum(moved.rotation) + jnp.sum(moved.translation)

    alone, both = eqx.filter_jit(value), eqx.filter_jit(jax.value_and_grad(value))
    given = ((here.points, there.points), *arguments)
    runs = {
        "gradient": lambda: jax.block_until_ready(both(*given)),
        "alignment": lambda: jax.block_until_ready(alone(*given)),
    }
    print(f"{label}: value and gradient beside the value (normals given)")
    for name, run in runs.items():
        first(name, run)
    show(clock(runs, repeats), dict.fromkeys(runs, ""))


def many(count, size, repeats):
    """The table of a batch."""
    batch = batch_case(count, size)
    print(f"{count} pairs of about {size} points")
    clouds = stack([PointCloud(item[i]) for i in (0, 1) for item in batch])
    number = lambda x: jnp.asarray(x, jnp.float32 if x.dtype == float else x.dtype)
    clouds = jax.tree.map(number, clouds)
    starts = rigid(np.stack([item[2] for item in batch]))
    side = lambda i: jax.tree.map(lambda x: x[i : i + count], clouds)
    items, runs = (side(0), side(count), starts), {}
    for label, (given, mesh) in (("", placed(items)), (", one device", (items, None))):
        call = lambda ours, given=given, mesh=mesh: jax.block_until_ready(
            ours.align_all(given, jnp.float32(GATE), mesh)
        )
        runs |= {name + label: partial(call, ours) for name, ours in OURS.items()}
    told = lambda tables: "median {:.4f} deg {:.4f} mm, worst {:.3f} {:.3f}".format(
        *_spread(
            [
                errors(t, item[3], item[0].mean(axis=0))
                for t, item in zip(tables, batch, strict=True)
            ]
        )
    )
    notes = {}
    for name, run in runs.items():
        found = first(name, run)
        pick = lambda i, t=found.target_from_source: jax.tree.map(lambda x: x[i], t)
        notes[name] = told([table_of(pick(i)) for i in range(count)])
        notes[name] += f", mean steps {np.mean(found.num_steps):.1f}"
    for name, peer in peers().items():
        runs[name] = lambda peer=peer: [peer(*item) for item in batch]
        notes[name] = told(runs[name]())
    show(clock(runs, repeats), notes)


def _spread(rows):
    rows = np.asarray(rows)
    return (*np.median(rows, axis=0), *rows.max(axis=0))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    cases = ["10k", "40k", "many", "gradient"]
    parser.add_argument("--cases", nargs="+", default=cases, choices=cases)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--door", action="store_true", help="the door `register` too")
    args = parser.parse_args()
    for case in args.cases:
        if case in ("10k", "40k"):
            size = 10_000 if case == "10k" else None
            one_pair(case, size, args.repeats, args.door)
        if case == "many":
            many(64, 2000, args.repeats)
        if case == "gradient":
            gradient("10k", 10_000, args.repeats)


if __name__ == "__main__":
    main()
