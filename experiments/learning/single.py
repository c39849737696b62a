"""One network for one shape against screened Poisson, on the same points.

python experiments/learning/single.py
"""

import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import (
    Grid,
    PointCloud,
    fields,
    fit_field,
    isosurface,
    learning,
    meshes,
    reconstruct,
)

KEY = jax.random.key(0)
GRID = Grid(jnp.full(3, -1.1, jnp.float32), jnp.full(3, 2.2 / 95), (96,) * 3)
HEIGHT = 2.0


def siren(cloud):
    """A SIREN of 3 x 64 units, 1500 steps."""
    return _fit(learning.NeuralField.siren(key=KEY), cloud)


def fourier(cloud):
    """Softplus units on Fourier features, 3 x 64, 1500 steps."""
    return _fit(learning.NeuralField.fourier(key=KEY), cloud)


def _fit(net, cloud):
    out = fit_field(net, cloud, key=KEY, adam=learning.Adam(num_steps=1500))
    return isosurface.extract(out.field, GRID).mesh


def poisson(cloud):
    """Screened Poisson at 96^3."""
    return reconstruct(cloud, resolution=96).mesh


def main():
    """The table."""
    truth = isosurface.extract(fields.demo_statue(), GRID).mesh
    truth = jax.tree.map(jnp.asarray, truth)
    print("| points | noise | road | Chamfer % | rms % | largest % | normals | s |")
    print("|---|---|---|---|---|---|---|---|")
    for num, noise in ((200, 0.0), (2000, 0.0), (2000, 0.01), (20000, 0.0)):
        cloud = meshes.sample_surface(truth, num, key=jax.random.key(1)).cloud()
        draws = np.random.default_rng(0).normal(size=(num, 3))
        points = np.asarray(cloud.points) + noise * draws
        oriented = PointCloud(points.astype(np.float32), np.asarray(cloud.normals))
        bare = PointCloud(oriented.points)
        for name, road, given in (
            ("screened Poisson", poisson, oriented),
            ("Fourier network", fourier, oriented),
            ("SIREN", siren, oriented),
            ("screened Poisson, estimated normals", poisson, bare),
            ("Fourier network, no normals", fourier, bare),
        ):
            began = time.time()
            mesh = jax.tree.map(jnp.asarray, road(given))
            seconds = time.time() - began
            e = meshes.evaluate(mesh, truth, key=KEY, num=20_000)
            errors = (e.chamfer, e.rms, e.hausdorff)
            told = " | ".join(f"{100 * float(x) / HEIGHT:.2f}" for x in errors)
            cosine = float(e.normal_consistency)
            print(
                f"| {num} | {noise} | {name} | {told} | {cosine:.3f} | {seconds:.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
