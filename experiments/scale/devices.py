"""How a batch is divided: the same work with one CPU device, and with one per core.

    python -m experiments.scale.devices [--devices 1 2]

Each number of devices is a process of its own. Medians of three runs after the first,
which compiles, in seconds. Ragged noisy scans of an ellipsoid: 48 alignments of 1 500
to 2 000 points, 24 reconstructions at 48^3, 24 meshes of fields at 64^3, 16 small
networks trained. XLA's own threads share some of the work of one device already.
"""

import argparse
import os
import statistics
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxgeom as jg
from jaxgeom import fields, learning


def scans(count, least, most):
    """Oriented points of ellipsoids, a little different each."""
    rng, out = np.random.default_rng(0), []
    for _ in range(count):
        x = rng.normal(size=(rng.integers(least, most), 3))
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        axes = np.array([1.0, 0.8, 0.6]) * rng.uniform(0.95, 1.05, 3)
        points = axes * x + 0.002 * rng.normal(size=x.shape)
        normals = x / axes / np.linalg.norm(x / axes, axis=1, keepdims=True)
        out.append(jg.PointCloud(np.float32(points), np.float32(normals)))
    return out


def tasks():
    """What is timed, by name."""
    clouds = scans(48, 1500, 2000)
    target = jg.pipelines.share_target(clouds[0])
    shift = jg.Rigid.exp(jnp.array([0.1, 0.05, -0.1, 0.05, 0.0, 0.05]))
    moved = jg.stack([shift(cloud) for cloud in clouds])
    some = jg.stack(clouds[:24])
    grid = jg.Grid(jnp.full(3, -1.0), jnp.full(3, 2 / 63), (64, 64, 64))
    balls = jax.vmap(fields.Torus)(
        jnp.linspace(0.5, 0.6, 24), jnp.linspace(0.2, 0.3, 24)
    )
    network = learning.NeuralField.siren(key=jax.random.key(0), width=32, depth=2)
    fitted = {
        "key": jax.random.key(1),
        "loss": learning.SurfaceLoss(batch=128),
        "adam": learning.Adam(num_steps=100, rate=5e-3),
    }
    few = jg.stack(clouds[:16])
    return {
        "register_many": lambda: jg.register_many(moved, target).rmse,
        "reconstruct_many": lambda: jg.reconstruct_many(some, resolution=48)[-1].mesh,
        "extract_many": lambda: jg.extract_many(balls, grid)[-1].mesh,
        "fit_many": lambda: jg.fit_many(network, few, **fitted)[-1].error,
    }


def measure():
    """Print the medians of this process."""
    for name, run in tasks().items():
        jax.block_until_ready(run())
        taken = []
        for _ in range(3):
            start = time.perf_counter()
            jax.block_until_ready(run())
            taken.append(time.perf_counter() - start)
        print(f"  {name} {statistics.median(taken):.2f}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--measure", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        return measure()
    for count in options.devices:
        print(f"{count} devices:", flush=True)
        flags = f"--xla_force_host_platform_device_count={count}"
        command = [sys.executable, "-m", "experiments.scale.devices", "--measure"]
        env = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
        subprocess.run(command, check=True, env=env)


if __name__ == "__main__":
    main()
