"""How fast closest points of a mesh, winding numbers and rays are (CPU).

    python experiments/neighbors/surface_speed.py DATA/meshes/nefertiti.ply

100 000 queries on an icosphere of 20 480 faces and on a given mesh: `box` in the
bounding cube, 1.2 times as wide; `near` at a tenth of that from the vertices. Beside
libigl (which builds its tree in the call) and Open3D's RaycastingScene (built before).
All take turns in one run; prints medians in ms, ours over the peers (below 1 is
faster), and the largest difference of the distances over the size of the mesh.
"""

import argparse
import time

import igl
import jax
import jax.numpy as jnp
import numpy as np
import open3d as o3d

from jaxgeom import io
from jaxgeom.meshes import icosphere
from jaxgeom.neighbors import (
    Hierarchical,
    cast_rays,
    closest_on_mesh,
    index_surface,
    winding_number,
)
from jaxgeom.shapes import TriangleMesh

NUM, ROUNDS = 100_000, 5


def medians(jobs):
    """The median time in ms of every job; they take turns."""
    times = {name: [] for name in jobs}
    for _ in range(ROUNDS + 1):
        for name, job in jobs.items():
            start = time.perf_counter()
            jax.block_until_ready(job())
            times[name].append(time.perf_counter() - start)
    return {name: 1e3 * float(np.median(x[1:])) for name, x in times.items()}


def report(title, found):
    """One line: times, and ours over each of the others."""
    text = "  ".join(f"{name} {ms:.0f} ms" for name, ms in found.items())
    others = {k: found["jaxgeom"] / v for k, v in found.items() if k != "jaxgeom"}
    ratios = "  ".join(f"/{k} {r:.2f}" for k, r in others.items())
    print(f"{title:34s} {text}   ratio {ratios}", flush=True)


def run(name, mesh):
    """All comparisons on one mesh."""
    v, f = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    v64, f64 = v.astype(float), f.astype(np.int64)
    rng = np.random.default_rng(0)
    low, high = v.min(axis=0), v.max(axis=0)
    half = (high - low).max() / 2
    box = (low + high) / 2 + half * rng.uniform(-1.2, 1.2, (NUM, 3))
    near = v[rng.integers(0, len(v), NUM)] + 0.02 * half * rng.normal(size=(NUM, 3))
    index = jax.block_until_ready(index_surface(mesh))
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(v, f.astype(np.uint32))
    closest = jax.jit(lambda i, q: closest_on_mesh(i, q))
    for kind, points in (("box", box), ("near", near)):
        q32 = points.astype(np.float32)
        q64, queries = q32.astype(float), jnp.asarray(q32)
        found = medians(
            {
                "jaxgeom": lambda q=queries: closest(index, q),
                "igl": lambda q=q64: igl.point_mesh_squared_distance(q, v64, f64),
                "Open3D": lambda q=q32: scene.compute_closest_points(q),
            }
        )
        report(f"closest, {name}, {kind}", found)
        want = np.sqrt(igl.point_mesh_squared_distance(q64, v64, f64)[0])
        error = np.abs(np.asarray(closest(index, queries).distances) - want).max()
        print(f"    largest difference to igl: {error / half:.1e} of the size")
    queries = jnp.asarray(box.astype(np.float32))
    q64 = np.asarray(queries).astype(float)
    around = jax.jit(lambda m, q: winding_number(m, q, method=Hierarchical()))
    jobs = {
        "jaxgeom": lambda: around(mesh, queries),
        "igl": lambda: igl.fast_winding_number(v64, f64, q64),
    }
    report(f"winding, {name}, box", medians(jobs))
    aims = near[rng.permutation(NUM)].astype(np.float32)
    ways = jnp.asarray(aims) - queries
    rays = np.concatenate([np.asarray(queries), np.asarray(ways)], axis=1)
    cast = jax.jit(lambda i, o, d: cast_rays(i, o, d))
    jobs = {
        "jaxgeom": lambda: cast(index, queries, ways),
        "Open3D": lambda: scene.cast_rays(rays),
    }
    report(f"rays, {name}, incoherent", medians(jobs))
    ours, theirs = cast(index, queries, ways), scene.cast_rays(rays)["t_hit"].numpy()
    both = np.isfinite(theirs) & np.asarray(ours.mask)
    lost = int((np.isfinite(theirs) != np.asarray(ours.mask)).sum())
    gap = np.abs(np.asarray(ours.t) - theirs)[both]
    apart = np.quantile(gap, 0.999)
    print(f"    hits that only one has: {lost}; t differs by {apart:.1e}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("meshes", nargs="*")
    single = lambda m: TriangleMesh(jnp.asarray(m.vertices, jnp.float32), m.faces)
    run("icosphere 20k", single(icosphere(5)))
    for path in parser.parse_args().meshes:
        run(path.split("/")[-1], single(io.load_mesh(path)))
