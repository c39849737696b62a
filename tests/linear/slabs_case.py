"""One sharded solve, run by the tests in processes with several devices."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from jaxgeom.linear import (
    Multigrid,
    SlabCosine,
    SlabMultigrid,
    conjugate_gradients,
    cosine_solve,
    laplacian,
    solve_in_slabs,
)

SHAPE = (64, 32, 48)
COEFFICIENTS = np.array([1.3, 0.7, 1.1], np.float32)
RTOL = 1e-4


def problem():
    """A right-hand side of mean zero, and a screening that lives on a few nodes."""
    rng = np.random.default_rng(3)
    b = rng.normal(size=SHAPE).astype(np.float32)
    b = b - b.mean()
    return b, (rng.random(SHAPE) < 0.05).astype(np.float32) * 2.5


def solver(mesh, method):
    return jax.jit(
        lambda b, d, c: solve_in_slabs(b, d, c, mesh=mesh, method=method, rtol=RTOL)
    )


def placed(mesh, *arrays):
    """The arrays, each process giving the slabs of its own devices."""
    cut = NamedSharding(mesh, P("x"))
    make = jax.make_array_from_callback
    return [make(a.shape, cut, lambda part, a=a: a[part]) for a in arrays]


def on_one_device(b, d):
    """What one device finds: with multigrid, and the exact inverse without D."""
    c = jnp.asarray(COEFFICIENTS)
    cycle = Multigrid.of(jnp.asarray(d), c).v_cycle
    apply = lambda u: laplacian(u, c) + d * u
    solve = lambda b: conjugate_gradients(
        apply, b, rtol=RTOL, max_steps=200, preconditioner=cycle
    )
    return jax.jit(solve)(b), jax.jit(cosine_solve)(b, c)


def memory(mesh, method, b, d):
    compiled = solver(mesh, method).lower(*placed(mesh, b, d), COEFFICIENTS).compile()
    sizes = compiled.memory_analysis()
    return sizes.argument_size_in_bytes + sizes.temp_size_in_bytes


def local():
    """Compare with one device, and measure what each device holds."""
    b, d = problem()
    flat = np.zeros_like(d)
    one, exact = on_one_device(b, d)
    devices, out = jax.devices(), {"devices": len(jax.devices())}
    mesh = Mesh(np.array(devices), ("x",))
    for method in (SlabMultigrid(), SlabCosine()):
        name = type(method).__name__
        found = solver(mesh, method)(*placed(mesh, b, d), COEFFICIENTS)
        gap = np.linalg.norm(np.asarray(found.value) - np.asarray(one.value))
        out[name] = {
            "gap": float(gap / np.linalg.norm(one.value)),
            "steps": int(found.steps),
            "residual": float(found.residual),
            "memory": [
                memory(Mesh(np.array(devices[:k]), ("x",)), method, b, d)
                for k in ((1, 2, 4, 8) if len(devices) == 8 else (1, len(devices)))
            ],
        }
    free = solver(mesh, SlabCosine())(*placed(mesh, b, flat), COEFFICIENTS)
    out["steps"] = int(one.steps)
    out["free_steps"] = int(free.steps)
    off = np.asarray(free.value) - np.asarray(exact)
    out["free_gap"] = float(np.linalg.norm(off) / np.linalg.norm(exact))
    print(json.dumps(out))


def distributed(port, index):
    """One of two processes with two devices each."""
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"127.0.0.1:{port}", 2, index)
    b, d = problem()
    mesh = Mesh(np.array(jax.devices()), ("x",))
    found = solver(mesh, SlabMultigrid())(*placed(mesh, b, d), COEFFICIENTS)
    whole = {
        s.index[0].start: np.asarray(s.data) for s in found.value.addressable_shards
    }
    one, _ = on_one_device(b, d)
    n = SHAPE[0] // jax.device_count()
    gaps = [
        np.abs(part - np.asarray(one.value)[start : start + n]).max()
        for start, part in whole.items()
    ]
    out = {"processes": jax.process_count(), "parts": len(gaps)}
    out |= {"gap": float(max(gaps)), "steps": int(found.steps)}
    print(json.dumps(out | {"one": int(one.steps)}))


if __name__ == "__main__":
    if len(sys.argv) == 1:
        local()
    else:
        distributed(int(sys.argv[1]), int(sys.argv[2]))
