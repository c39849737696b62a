"""Marching cubes on narrow bands against dense grids: seconds and peak memory.

Each line is measured in a process of its own. One run compiles, the next is timed:

    python experiments/fields/narrow_band.py sphere 1024 band
    python experiments/fields/narrow_band.py gyroid 512 dense
"""

import argparse
import resource
import time

import jax
import jax.numpy as jnp

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


def _peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main():
    """Measure one case."""
    parser = argparse.ArgumentParser()
    parser.add_argument("field", choices=FIELDS)
    parser.add_argument("resolution", type=int)
    parser.add_argument("form", choices=("band", "dense"))
    parser.add_argument("--repeat", type=int, default=2)
    parser.add_argument("--no-normals", dest="normals", action="store_false")
    parser.add_argument("--check", action="store_true", help="topology of the mesh")
    arguments = parser.parse_args()
    run = band if arguments.form == "band" else dense
    method = MarchingCubes(normals=arguments.normals)
    case = f"{arguments.field} {arguments.resolution}^3 {arguments.form}"
    print(f"{case}, start {_peak():.2f} GiB")
    for _ in range(arguments.repeat):
        out, seconds = run(FIELDS[arguments.field], arguments.resolution, method)
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
