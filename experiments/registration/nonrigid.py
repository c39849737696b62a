"""Non-rigid registration of a real mesh bent by a known warp, beside trimesh (CPU).

    python experiments/registration/nonrigid.py DATA/meshes/bunny.ply --vertices 10000

The target is the mesh bent by a smooth warp of about a tenth of its size; the template
is the mesh as it was, simplified by Open3D to about so many vertices. As the warp is
known, so is where every vertex of the template belongs. Each method runs in a process
of its own, so that its peak memory (resident set, interpreter included) is its own.
Prints, in percent of the half diagonal, the root mean square of what the warp did and
of what is left, the distance to the target, seconds of the first call and of the next
one, and the peak in MiB.
"""

import argparse
import pathlib
import resource
import subprocess
import sys
import time

import numpy as np

MODELS = ["rigid_parts", "affine", "graph", "trimesh_amberg"]


def warp(points):
    """A bend, a twist and a swell, in units of the half diagonal."""
    x, y, z = points.T
    turn = 0.35 * y
    bent = np.stack(
        [np.cos(turn) * x - np.sin(turn) * z, y, np.sin(turn) * x + np.cos(turn) * z], 1
    )
    swell = [0.08 * np.sin(2.1 * y + 0.3), 0.06 * np.cos(1.7 * x), 0.1 * x * y]
    return bent + np.stack(swell, 1)


def cases(path, vertices):
    """(vertices, faces) of the template, its truth, (vertices, faces) of the target."""
    import trimesh

    mesh = trimesh.load(path, process=False)
    center = (mesh.vertices.max(0) + mesh.vertices.min(0)) / 2
    size = np.linalg.norm(mesh.vertices.max(0) - mesh.vertices.min(0)) / 2
    points, faces = (mesh.vertices - center) / size, np.asarray(mesh.faces)
    low, low_faces = _simplified(points, faces, vertices)
    return (low, low_faces), warp(low), (warp(points), faces)


def _simplified(points, faces, vertices):
    if len(points) <= vertices:
        return points, faces
    import open3d as o3d

    full = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(points), o3d.utility.Vector3iVector(faces)
    )
    low = full.simplify_quadric_decimation(2 * vertices)
    return np.asarray(low.vertices), np.asarray(low.triangles)


def ours(name, template, target):
    """A function that returns the deformed vertices."""
    import jax
    import jax.numpy as jnp

    from jaxgeom.registration import (
        AsRigidAsPossible,
        EmbeddedGraph,
        PerVertexAffine,
        nonrigid,
    )
    from jaxgeom.shapes import TriangleMesh

    models = {
        "rigid_parts": AsRigidAsPossible(),
        "affine": PerVertexAffine(),
        "graph": EmbeddedGraph(),
    }
    as_mesh = lambda m: TriangleMesh(jnp.asarray(m[0], jnp.float32), jnp.asarray(m[1]))
    template, target = as_mesh(template), as_mesh(target)
    run = jax.jit(lambda a, b: nonrigid(a, b, model=models[name]))
    return lambda: np.asarray(run(template, target).mesh.vertices)


def peer(template, target):
    """trimesh's optimal-step registration, with its own schedule."""
    import trimesh
    from trimesh.registration import nricp_amberg

    template = trimesh.Trimesh(*template, process=False)
    target = trimesh.Trimesh(*target, process=False)
    # Closest points of faces need a package of their own there: points, with normals.
    return lambda: nricp_amberg(template, target, use_faces=False)


def measure(name, path, vertices):
    """Run one method and print its row."""
    from scipy.spatial import cKDTree

    template, truth, target = cases(path, vertices)
    run = (
        peer(template, target)
        if name == "trimesh_amberg"
        else ours(name, template, target)
    )
    seconds = []
    for _ in range(1 if name == "trimesh_amberg" else 2):
        start = time.perf_counter()
        found = run()
        seconds.append(time.perf_counter() - start)
    rms = lambda x: 100 * np.sqrt(np.mean(np.sum(x**2, axis=1)))
    near = cKDTree(target[0]).query(found)[0]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{name:15} {len(truth):6} {rms(template[0] - truth):8.3f} "
        f"{rms(found - truth):8.3f} {100 * np.sqrt(np.mean(near**2)):8.3f} "
        f"{seconds[0]:8.1f} {seconds[-1]:8.1f} {peak:8.0f}",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mesh", type=pathlib.Path)
    parser.add_argument("--vertices", type=int, default=10_000)
    parser.add_argument("--methods", nargs="+", default=MODELS)
    parser.add_argument("--only")
    args = parser.parse_args()
    if args.only:
        return measure(args.only, args.mesh, args.vertices)
    names = ["vertices", "moved %", "left %", "to points", "first s", "next s", "MiB"]
    print(f"{'method':13}" + "".join(f"{name:>9}" for name in names))
    for name in args.methods:
        command = [sys.executable, __file__, str(args.mesh), "--only", name]
        subprocess.run([*command, "--vertices", str(args.vertices)], check=True)


if __name__ == "__main__":
    main()
