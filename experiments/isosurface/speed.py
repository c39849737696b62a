"""How fast marching cubes is beside scikit-image and VTK's flying edges (CPU).

    python experiments/isosurface/speed.py --sizes 128 256 --repeats 7

Prints, per field and size, the median time in ms of the compiled form with shared
vertices, without and with normals, and its ratio to each peer (below 1 is faster). Ours
and the peers take turns, so that other load on the machine hits all of them. Peers that
are not installed are left out. Fresh large buffers cost page faults: compare also with
`GLIBC_TUNABLES=glibc.malloc.hugetlb=1` in the environment.
"""

import argparse
import time

import jax
import numpy as np

from jaxgeom._core import runtime_token
from jaxgeom.isosurface import Capacity, count, marching_cubes
from jaxgeom.shapes import Grid


def gyroid(n):
    """Four periods along each axis."""
    x, y, z = _axes(n, 8 * np.pi)
    sin, cos = np.sin, np.cos
    return sin(x) * cos(y) + sin(y) * cos(z) + sin(z) * cos(x)


def sphere(n):
    """A ball of 0.4 of the grid's width."""
    x, y, z = _axes(n, 1.0)
    return np.sqrt((x - 0.5) ** 2 + (y - 0.5) ** 2 + (z - 0.5) ** 2) - 0.4


def noise(n):
    """White noise, smoothed by a few cells."""
    values = np.random.default_rng(0).standard_normal((n, n, n)).astype(np.float32)
    for axis in range(3):
        for step in (1, 2):
            values = values + np.roll(values, step, axis)
    return values


def _axes(n, width):
    return np.meshgrid(*[np.linspace(0, width, n, dtype=np.float32)] * 3, indexing="ij")


def ours(values, normals):
    """The compiled form, with capacities measured before."""
    grid = Grid(np.zeros(3, np.float32), np.ones(3, np.float32), values.shape)
    values = jax.numpy.asarray(values)
    needed = jax.jit(count)(values)
    sizes = (int(needed.vertices), int(needed.faces), int(needed.cells))
    capacity = Capacity.holding(*sizes)

    @jax.jit
    def run(values, token):
        return marching_cubes(
            values, grid, capacity=capacity, normals=normals, token=token
        )

    token = runtime_token()
    return lambda: jax.block_until_ready(run(values, token))


def peers(values):
    """Name -> function, for the peers that are installed."""
    out = {}
    try:
        from skimage.measure import marching_cubes as skimage_cubes

        out["skimage"] = lambda: skimage_cubes(values, 0.0)
    except ImportError:
        pass
    try:
        out["vtk"] = _flying_edges(values)
    except ImportError:
        pass
    try:
        out["warp"] = _warp_cubes(values)
    except ImportError:
        pass
    return out


def _warp_cubes(values):
    """Marching cubes of warp on its CPU device."""
    import warp as wp
    import warp.geometry

    wp.config.quiet = True
    held = wp.array(np.ascontiguousarray(values, np.float32), device="cpu")
    cubes = wp.geometry.IsoSurfaceMarchingCubes
    return lambda: cubes.extract(held, 0.0)


def _flying_edges(values):
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    image = vtkImageData()
    image.SetDimensions(*values.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(values.reshape(-1)))
    edges = vtkFlyingEdges3D()
    edges.SetInputData(image)
    edges.SetValue(0, 0.0)
    edges.ComputeNormalsOff()
    edges.ComputeScalarsOff()

    def run():
        edges.Modified()
        edges.Update()

    return run


def medians(functions, repeats):
    """The median time in ms of each function, called in turns."""
    times = {name: [] for name in functions}
    for function in functions.values():
        function()
    for _ in range(repeats):
        for name, function in functions.items():
            start = time.perf_counter()
            function()
            times[name].append(time.perf_counter() - start)
    return {name: 1e3 * float(np.median(taken)) for name, taken in times.items()}


def main():
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    for n in options.sizes:
        for field in (gyroid, sphere, noise):
            values = np.ascontiguousarray(field(n), np.float32)
            functions = {
                "plain": ours(values, False),
                "normals": ours(values, True),
                **peers(values),
            }
            taken = medians(functions, options.repeats)
            report = [f"{name} {ms:.1f}" for name, ms in taken.items()]
            for peer in list(taken)[2:]:
                for own in ("plain", "normals"):
                    report.append(f"{own}/{peer} {taken[own] / taken[peer]:.2f}")
            print(f"{n}^3 {field.__name__}:", " | ".join(report), flush=True)


if __name__ == "__main__":
    main()
