"""Marching cubes on narrow bands against dense grids and sparse peers: seconds, memory.

Each line is measured in a process of its own. One run compiles, the next is timed:

    python experiments/fields/narrow_band.py sphere 1024 band
    python experiments/fields/narrow_band.py gyroid 512 dense
    python experiments/fields/narrow_band.py sphere 1024 warp

The peers, libigl (`lipschitz_octree`, its field in numpy) and warp
(`sparse_marching_cubes`, its field a kernel), get the same surface as a function of
Lipschitz constant one, and no normals are asked of them.
"""

import argparse
import math
import resource
import time
import types

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom.fields import NarrowBand, Sphere, gyroid
from jaxgeom.isosurface import MarchingCubes, extract
from jaxgeom.meshes import topology
from jaxgeom.shapes import Grid

FIELDS = {
    "sphere": Sphere(0.4, (0.011, -0.007, 0.013)),
    # Four periods within a ball.
    "gyroid": gyroid(0.25) & Sphere(0.47),
}


def grid_of(n):
    """The unit cube about the origin."""
    return Grid(jnp.full(3, -0.5), jnp.full(3, 1 / (n - 1)), (n, n, n))


def band(field, n, method):
    """The mesh of the band, and the seconds of its two halves."""
    start = time.perf_counter()
    found = NarrowBand.around(field, grid_of(n))
    middle = time.perf_counter()
    out = extract(found, method=method)
    print(f"  {int(found.num_bricks)} bricks of {(-(-n // 8)) ** 3}")
    return out, (middle - start, time.perf_counter() - middle)


def dense(field, n, method):
    """The mesh of the dense grid, and its seconds."""
    start = time.perf_counter()
    out = extract(field, grid_of(n), method=method)
    jax.block_until_ready(out)
    return out, (time.perf_counter() - start,)


_CENTER = np.array([0.011, -0.007, 0.013])
_STEEP = math.sqrt(6) * 2 * math.pi / 0.25


def in_numpy(name):
    """A field of Lipschitz constant one of points [n, 3]."""
    if name == "sphere":
        return lambda p: np.linalg.norm(p - _CENTER, axis=1) - 0.4

    def both(p):
        (a, b, c), (x, y, z) = (g(2 * np.pi / 0.25 * p.T) for g in (np.cos, np.sin))
        ball = np.linalg.norm(p, axis=1) - 0.47
        return np.maximum((x * b + y * c + z * a) / _STEEP, ball)

    return both


def of_libigl(name, n):
    """The mesh of libigl: cells by its octree, a power of two along each axis."""
    import igl

    field, depth = in_numpy(name), math.ceil(math.log2(n - 1))
    start = time.perf_counter()
    origin, width = np.full(3, -0.5), 1.0
    cells = igl.lipschitz_octree(origin, width, depth, lambda p: np.abs(field(p)))
    middle = time.perf_counter()
    # Of the corners and their places only these are needed.
    _, corners, places = igl.unique_sparse_voxel_corners(origin, width, depth, cells)
    vertices, faces, _ = igl.marching_cubes(field(places), places, corners, 0.0)
    seconds = (middle - start, time.perf_counter() - middle)
    return _mesh(vertices, faces), seconds


def of_warp(name, n):
    """The mesh of warp, on the CPU."""
    import warp as wp
    import warp.geometry

    center, steep, wave = wp.vec3(*_CENTER), wp.float32(_STEEP), 2 * math.pi / 0.25

    @wp.kernel
    def sphere(p: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)):
        i = wp.tid()
        out[i] = wp.length(p[i] - center) - 0.4

    @wp.kernel
    def gyroid(p: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)):
        i = wp.tid()
        u = wave * p[i]
        raw = wp.sin(u[0]) * wp.cos(u[1]) + wp.sin(u[1]) * wp.cos(u[2])
        raw = raw + wp.sin(u[2]) * wp.cos(u[0])
        out[i] = wp.max(raw / steep, wp.length(p[i]) - 0.47)

    kernel = sphere if name == "sphere" else gyroid

    def field(points):
        out = wp.empty(len(points), dtype=wp.float32, device="cpu")
        wp.launch(kernel, len(points), [points], [out], device="cpu")
        return out

    box = {"lower": (-0.5, -0.5, -0.5), "upper": (0.5, 0.5, 0.5)}
    sparse = wp.geometry.sparse_marching_cubes
    start = time.perf_counter()
    vertices, faces = sparse(field, n, n, n, **box, device="cpu")
    return _mesh(vertices, faces.reshape((-1, 3))), (time.perf_counter() - start,)


def _mesh(vertices, faces):
    return types.SimpleNamespace(
        mesh=types.SimpleNamespace(vertices=vertices, faces=faces)
    )


def _peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main():
    """Measure one case."""
    parser = argparse.ArgumentParser()
    parser.add_argument("field", choices=FIELDS)
    parser.add_argument("resolution", type=int)
    parser.add_argument("form", choices=("band", "dense", "libigl", "warp"))
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--no-normals", dest="normals", action="store_false")
    parser.add_argument("--check", action="store_true", help="topology of the mesh")
    arguments = parser.parse_args()
    method = MarchingCubes(normals=arguments.normals)
    run = {
        "band": lambda name, n: band(FIELDS[name], n, method),
        "dense": lambda name, n: dense(FIELDS[name], n, method),
        "libigl": of_libigl,
        "warp": of_warp,
    }[arguments.form]
    case = f"{arguments.field} {arguments.resolution}^3 {arguments.form}"
    print(f"{case}, start {_peak():.2f} GiB")
    for _ in range(arguments.repeat):
        out, seconds = run(arguments.field, arguments.resolution)
        parts = " + ".join(f"{s:.2f}" for s in seconds)
        print(
            f"  {parts} s, peak {_peak():.2f} GiB, "
            f"{len(out.mesh.vertices)} vertices, {len(out.mesh.faces)} faces"
        )
    if arguments.check:
        found = vars(topology(out.mesh)).items()
        print("  " + ", ".join(f"{name} {int(value)}" for name, value in found))


if __name__ == "__main__":
    main()
