"""How fast all extractors are beside scikit-image, VTK's flying edges and warp (CPU).

    python experiments/isosurface/extractors_speed.py --sizes 128 --repeats 5 --batch 16

Prints the median time in ms of the compiled forms on sampled values, and of a loop of
the peers over the grids of a batch. All take turns, so that other load on the machine
hits all of them.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from speed import gyroid, medians, peers, sphere

from jaxgeom._core import runtime_token
from jaxgeom.isosurface import (
    Capacity,
    DualContouring,
    DualMarchingCubes,
    FlexiCubes,
    MarchingCubes,
)
from jaxgeom.shapes import Grid

METHODS = {
    "marching cubes": MarchingCubes(normals=False),
    "dual marching cubes": DualMarchingCubes(),
    "dual contouring": DualContouring(),
    "flexicubes": FlexiCubes(),
}


def compiled(method, values):
    """The compiled form on one grid [x, y, z], or on a batch [b, x, y, z] by vmap."""
    shape = values.shape[-3:]
    grid = Grid(np.zeros(3, np.float32), np.ones(3, np.float32), shape)
    values, batched = jnp.asarray(values), values.ndim == 4
    measure = jax.vmap(method.measure) if batched else method.measure
    needed = jax.tree.map(jnp.max, jax.jit(measure)(values))
    sizes = (int(needed.vertices), int(needed.faces), int(needed.cells))
    capacity = Capacity.holding(*sizes)

    @jax.jit
    def run(values, token):
        one = lambda v: method(v, grid, capacity=capacity, token=token)
        return (jax.vmap(one) if batched else one)(values)

    token = runtime_token()
    return lambda: jax.block_until_ready(run(values, token))


def report(name, functions, repeats):
    """One line: times, and ratios to the peers."""
    taken = medians(functions, repeats)
    line = [f"{label} {ms:.1f}" for label, ms in taken.items()]
    for peer in ("skimage", "vtk", "warp"):
        if peer in taken:
            ratios = [f"{taken[own] / taken[peer]:.2f}" for own in METHODS]
            line.append(f"over {peer}: " + ", ".join(ratios))
    print(f"{name}:", " | ".join(line), flush=True)


def main():
    """Run the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[128])
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--batch", type=int, default=16)
    options = parser.parse_args()
    for n in options.sizes:
        for field in (gyroid, sphere):
            values = np.ascontiguousarray(field(n), np.float32)
            own = {label: compiled(m, values) for label, m in METHODS.items()}
            functions = own | peers(values)
            report(f"{n}^3 {field.__name__}", functions, options.repeats)
    if options.batch:
        base = np.ascontiguousarray(gyroid(64), np.float32)
        batch = base + np.linspace(-0.3, 0.3, options.batch)[:, None, None, None]
        batch = batch.astype(np.float32)
        own = {label: compiled(m, batch) for label, m in METHODS.items()}
        each = [peers(values) for values in batch]
        loops = {
            name: lambda name=name: [some[name]() for some in each] for name in each[0]
        }
        report(f"{options.batch} x 64^3 gyroid", own | loops, options.repeats)


if __name__ == "__main__":
    main()
