"""How fast a reconstruction is beside Open3D, and what compiling and gradients cost.

    JAXGEOM_DATA=... python experiments/reconstruction/speed.py --depths 7 8

Points in, indexed mesh out: the compiled form with measured capacity against Open3D's
Poisson at the same depth with as many threads as cores, in turns, medians. Then the
time to compile, the peak memory of the process, and the cost of the gradient of a loss
on the mesh with respect to all points and normals, in forward passes. `--solvers`
compares the preconditioners. Large fresh buffers cost page faults: run it also with
GLIBC_TUNABLES=glibc.malloc.hugetlb=1.
"""

import argparse
import os
import resource
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxgeom as jg
from jaxgeom.isosurface import Capacity, Cubic, MarchingCubes, count
from jaxgeom.linear import (
    Multigrid,
    conjugate_gradients,
    cosine_solve,
    interpolate,
    laplacian,
    splat,
)
from jaxgeom.reconstruction import screened_poisson

sys.path.insert(0, os.path.dirname(__file__))
import cases


def compiled(cloud, resolution):
    """The compiled form, what it compiles in, and its arguments."""
    cloud = jax.tree.map(jnp.asarray, cloud)
    token = jg.runtime_token()
    grid = jg.Grid.around(cloud, resolution=resolution)
    solve = jax.jit(lambda c, t: screened_poisson(c, grid, token=t))
    field = solve(cloud, token)
    needed = jax.jit(count)(field.values, field.level)
    capacity = Capacity.holding(*(int(n) for n in jax.tree.leaves(needed)))
    method = MarchingCubes(placement=Cubic())

    def run(cloud, token):
        settings = dict(resolution=resolution, capacity=capacity, extractor=method)
        return jg.reconstruct_jit(cloud, token=token, **settings)

    def loss(points, normals, token):
        mesh = run(jg.PointCloud(points, normals), token).mesh
        return jnp.sum(mesh.vertices**2) / mesh.num_vertices

    gradient = jax.jit(jax.grad(loss, argnums=(0, 1)))
    start = time.perf_counter()
    forward = jax.jit(run).lower(cloud, token).compile()
    seconds = time.perf_counter() - start
    out = {
        "ours": lambda: jax.block_until_ready(forward(cloud, token)),
        "gradient": lambda: jax.block_until_ready(
            gradient(cloud.points, cloud.normals, token)
        ),
    }
    return out, seconds


def open3d(cloud, depth):
    """Open3D's Poisson."""
    import open3d as o3d

    points = np.asarray(cloud.points, np.float64)
    given = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    normals = np.asarray(cloud.normals, np.float64)
    given.normals = o3d.utility.Vector3dVector(normals)
    create = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson
    return lambda: create(given, depth=depth, n_threads=os.cpu_count())


def medians(functions, repeats):
    """The median seconds of each function, called in turns after one warm-up."""
    times = {name: [] for name in functions}
    for function in functions.values():
        function()
    for _ in range(repeats):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(taken)) for name, taken in times.items()}


def solvers(cloud, resolution, alpha=4.0):
    """Steps and seconds to 1e-4, without a start, by preconditioner."""
    grid = jg.Grid.around(cloud, resolution=resolution)
    q, shape = grid.index_of(jnp.asarray(cloud.points)), grid.shape
    area = 4 * resolution**2 / len(cloud.points)
    pull, ones = jnp.full(len(q), alpha * area), jnp.ones(3)
    b = splat(jnp.sin(20 * q[:, 0]), q, shape)
    token = jg.runtime_token()

    def solve(kind, b, q, token):
        operator = lambda u: (
            laplacian(u, ones) + splat(pull * interpolate(u, q), q, shape)
        )
        by = {
            "none": lambda r: r,
            "cosine": lambda r: cosine_solve(r, ones, jnp.sum(pull) / b.size),
            "multigrid": Multigrid.of(splat(pull, q, shape), ones, token).v_cycle,
        }[kind]
        return conjugate_gradients(
            operator, b, rtol=1e-4, max_steps=400, preconditioner=by
        )

    for kind in ("none", "cosine", "multigrid"):
        run = jax.jit(lambda b, q, t, kind=kind: solve(kind, b, q, t))
        out = run(b, q, token)
        again = lambda run=run: jax.block_until_ready(run(b, q, token))
        seconds = medians({kind: again}, 3)[kind]
        print(f"{resolution}^3 {kind}: {int(out.steps)} steps, {seconds:.2f} s")


def main():
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--depths", type=int, nargs="+", default=[7, 8])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--solvers", action="store_true")
    parser.add_argument("--only-ours", action="store_true", help="for peak memory")
    options = parser.parse_args()
    (case,) = cases.load(os.environ["JAXGEOM_DATA"], ["nefertiti-7"])
    for depth in options.depths:
        if options.solvers:
            solvers(case.cloud, 2**depth)
            continue
        functions, seconds = compiled(case.cloud, 2**depth)
        if options.only_ours:
            functions["ours"]()
        else:
            functions["open3d"] = open3d(case.cloud, depth)
            found = medians(functions, options.repeats)
            ratio = found["ours"] / found["open3d"]
            passes = found["gradient"] / found["ours"]
            text = " | ".join(f"{name} {s:.3f} s" for name, s in found.items())
            text += f" | ours/open3d {ratio:.3f} | gradient/ours {passes:.2f}"
            print(f"{2**depth}^3: {text}", flush=True)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        print(f"{2**depth}^3: compiled in {seconds:.1f} s, peak {peak:.2f} GiB")


if __name__ == "__main__":
    main()
