"""How often marching cubes has the Euler characteristic of the trilinear interpolant.

    python experiments/isosurface/euler.py

White noise on 6^3 nodes, 200 times, closed by a layer outside; the truth is marching
cubes of the interpolant sampled 8 times as finely. Prints the share of equal Euler
characteristics, and the mean difference, without and with the asymptotic decider; then
the same for fields of waves, which are smoother.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom.isosurface import (
    AsymptoticDecider,
    Capacity,
    MarchingCubes,
    SeparateInside,
    pad_outside,
)
from jaxgeom.linear import interpolate
from jaxgeom.meshes import topology
from jaxgeom.shapes import Grid

NODES, FINER, FIELDS = 6, 8, 200


def waves(rng):
    """Twelve plane waves of lengths from two to six cells."""
    x = np.moveaxis(np.indices((NODES,) * 3), 0, -1)
    out = 0
    for _ in range(12):
        k = rng.standard_normal(3)
        k *= 2 * np.pi / rng.uniform(2, 6) / np.linalg.norm(k)
        out = out + rng.standard_normal() * np.cos(x @ k + rng.uniform(0, 2 * np.pi))
    return out


def euler(values, ambiguity, capacity):
    """The Euler characteristic of the mesh of some values."""
    grid = Grid(jnp.zeros(3), jnp.ones(3), values.shape)
    method = MarchingCubes(ambiguity=ambiguity, normals=False)
    return topology(method(values, grid, capacity=capacity).mesh).euler


@jax.jit
def three(values):
    """The truth, without and with the decider."""
    unit = Grid(jnp.zeros(3), jnp.ones(3), values.shape)
    values, _ = pad_outside(values, unit)
    count = (NODES + 1) * FINER + 1
    axis = jnp.arange(count) / FINER
    at = jnp.stack(jnp.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    fine = interpolate(values, at.reshape(-1, 3)).reshape((count,) * 3)
    truth = euler(fine, AsymptoticDecider(), Capacity(60_000, 120_000))
    coarse = Capacity(700, 1600)
    plain = euler(values, SeparateInside(), coarse)
    return truth, plain, euler(values, AsymptoticDecider(), coarse)


def main():
    """Two lines per kind of field."""
    rng = np.random.default_rng(0)
    kinds = {
        "white noise": lambda: rng.standard_normal((NODES,) * 3),
        "waves": lambda: waves(rng),
    }
    for kind, make in kinds.items():
        found = np.array([three(jnp.float32(make())) for _ in range(FIELDS)])
        for label, column in (("separate", 1), ("decider", 2)):
            gap = found[:, column] - found[:, 0]
            print(f"{kind}, {label}: {np.mean(gap == 0):.3f} equal, {gap.mean():+.2f}")


if __name__ == "__main__":
    main()
