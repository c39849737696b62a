"""Memory of each device for one screened solve, by the number of devices.

python experiments/linear/slabs.py 256
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from jaxgeom.linear import SlabCosine, SlabMultigrid, solve_in_slabs


def memory(resolution, devices, method):
    """Bytes of arguments, results and scratch of one device, from the compiler."""
    mesh = Mesh(np.array(jax.devices()[:devices]), ("x",))
    cut = NamedSharding(mesh, P("x"))
    grid = jax.ShapeDtypeStruct((resolution,) * 3, jnp.float32, sharding=cut)
    weights = jax.ShapeDtypeStruct((3,), jnp.float32)
    solve = jax.jit(
        lambda b, d, c: solve_in_slabs(b, d, c, mesh=mesh, method=method, rtol=1e-4)
    )
    sizes = solve.lower(grid, grid, weights).compile().memory_analysis()
    parts = (
        sizes.argument_size_in_bytes,
        sizes.output_size_in_bytes,
        sizes.temp_size_in_bytes,
    )
    return sum(parts)


def main():
    """Print one row for each number of devices."""
    jax.config.update("jax_num_cpu_devices", 8)
    resolution = int(sys.argv[1])
    for devices in (1, 2, 4, 8):
        sizes = [
            memory(resolution, devices, m) for m in (SlabCosine(), SlabMultigrid())
        ]
        print(devices, *(f"{size / 2**20:.1f} MiB" for size in sizes), flush=True)


if __name__ == "__main__":
    main()
