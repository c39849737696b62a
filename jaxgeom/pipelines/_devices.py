"""A batch divided among the local devices, each with a loop over its own share."""

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P


def placed(items):
    """The items [b, ...] with a share on each local device, and the mesh of devices.

    An uneven batch repeats its last item. One device, or one item, needs no mesh: None.
    """
    b, num_devices = len(jax.tree.leaves(items)[0]), jax.local_device_count()
    if num_devices == 1 or b == 1:
        return items, None
    rows = np.minimum(np.arange(-(-b // num_devices) * num_devices), b - 1)
    mesh = Mesh(np.asarray(jax.local_devices()), ("scan",))
    place = lambda x: jax.device_put(
        np.asarray(x)[rows], NamedSharding(mesh, P("scan"))
    )
    return jax.tree.map(place, items), mesh


def on_each(run, mesh):
    """`run(items, common)` on every device of a mesh; `common` is the same for all."""
    if mesh is None:
        return run
    # Each device loops over its own scans: a loop over a divided axis would not.
    spread = {"in_specs": (P("scan"), P()), "out_specs": P("scan")}
    return jax.shard_map(run, mesh=mesh, check_vma=False, **spread)


def gathered(found, b: int):
    """The first `b` items of what all devices found, on the host."""
    return jax.tree.map(lambda x: np.asarray(x)[:b], found)
