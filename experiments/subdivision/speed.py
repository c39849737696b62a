"""Loop's scheme twice on an icosphere: planning and applying, against the peers.

    [JAX_ENABLE_X64=1] python experiments/subdivision/speed.py [MESH.ply]

With a PLY file as argument: the scheme once on that mesh. Needs igl, open3d and
trimesh. All tools take turns in every repetition; medians.
"""

import os
import statistics
import sys
import time

import igl
import jax
import numpy as np
import open3d
import trimesh

import jaxgeom
from jaxgeom import io
from jaxgeom.meshes import icosphere
from jaxgeom.subdivision import CatmullClark, Loop, Warren, limit, plan_subdivision

REPEATS = 25


def timed(function):
    start = time.perf_counter()
    jax.block_until_ready(function())
    return 1e3 * (time.perf_counter() - start)


def legacy(vertices, faces):
    return open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(vertices), open3d.utility.Vector3iVector(faces)
    )


def cases(mesh, levels):
    """Named functions that each do the work once."""
    v, f = np.array(mesh.vertices, float), np.array(mesh.faces, np.int64)
    source = legacy(v, f)
    loop = Loop(Warren())
    plan = plan_subdivision(mesh, levels, scheme=loop)
    merged = plan.operator.merged()
    apply = jax.jit(lambda s, x: s @ x)
    gradient = jax.jit(jax.grad(lambda x, s: ((s @ x) ** 2).sum()))
    x = jax.numpy.asarray(mesh.vertices)
    many = jax.numpy.stack([x] * 16, axis=1)
    batch = jax.numpy.stack([x] * 16)
    mapped = jax.jit(jax.vmap(lambda s, x: s @ x, in_axes=(None, 0)))
    matrix = merged.to_scipy().astype(x.dtype)

    def both():
        planned = plan_subdivision(mesh, levels, scheme=loop)
        return apply(planned.operator, x)

    return {
        "jaxgeom plan": lambda: plan_subdivision(mesh, levels, scheme=loop),
        "jaxgeom S @ V": lambda: apply(plan.operator, x),
        "jaxgeom plan + S @ V": both,
        "igl.loop": lambda: igl.loop(v, f, levels),
        "trimesh subdivide_loop": lambda: trimesh.remesh.subdivide_loop(v, f, levels),
        "open3d subdivide_loop": lambda: source.subdivide_loop(levels),
        "jaxgeom S @ V, merged S": lambda: apply(merged, x),
        "scipy csr @ V": lambda: matrix @ np.asarray(x),
        "jaxgeom gradient": lambda: gradient(x, plan.operator),
        "jaxgeom S @ [v, 16, 3]": lambda: apply(plan.operator, many),
        "jaxgeom S @ V, vmap of 16": lambda: mapped(plan.operator, batch),
        "jaxgeom plan, Catmull-Clark": lambda: plan_subdivision(
            mesh, levels, scheme=CatmullClark()
        ),
        "jaxgeom limit": lambda: limit(mesh, scheme=loop),
    }


def main(path=None):
    mesh = icosphere(4) if path is None else io.load_mesh(path)
    work = cases(mesh, 2 if path is None else 1)
    for function in work.values():
        timed(function)
        timed(function)
    times = {name: [] for name in work}
    for _ in range(REPEATS if path is None else 5):
        for name, function in work.items():
            times[name].append(timed(function))
    print(f"jaxgeom {jaxgeom.__version__}, {mesh.faces.shape[0]} faces, load", end=" ")
    print(round(os.getloadavg()[0], 1))
    base = statistics.median(times["jaxgeom plan + S @ V"])
    for name, each in times.items():
        middle = statistics.median(each)
        print(
            f"{name:30s} {middle:8.2f} ms  x {middle / base:6.2f}  min {min(each):.2f}"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
