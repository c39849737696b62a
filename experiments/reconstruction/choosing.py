"""Which method for which input: the Chamfer distance of each on six kinds of points.

    JAXGEOM_DATA=... python experiments/reconstruction/choosing.py --shapes horse bunny

For every shape, in its unit box (longest side 1): clean (50 000 oriented points), noisy
(deviation 0.005, normals about 0.1 off), sparse (200), partial (seen from one side, 20
degrees past the rim), unoriented (50 000 bare points), and open (the part above a plane
through the middle, whose border is known to nobody). All methods with their defaults,
128 nodes a side (64 for the sparse ones and for the stochastic mean). The distance is
CD-L1 of 100 000 samples in thousandths, about 1.9 for a surface and itself; for partial
and open inputs the truth is the whole and the part. Nothing was tuned on these shapes.
"""

import argparse
import os
import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import jaxgeom as jg
from jaxgeom import learning
from jaxgeom.io import load_mesh
from jaxgeom.isosurface import extract
from jaxgeom.meshes import keep_faces, large_components
from jaxgeom.normals import WindingConsistency
from jaxgeom.reconstruction import (
    SSD,
    Poisson,
    ScreenedPoisson,
    Wavelet,
    stochastic_poisson,
)
from jaxgeom.shapes import Grid, PointCloud

sys.path.insert(0, os.path.dirname(__file__))
import accuracy
import cases

MANY, FEW, NOISE = 50_000, 200, 0.005


def inputs(mesh):
    """Name, cloud and truth of every kind."""
    drawn = jax.device_get(jg.meshes.sample_surface(mesh, MANY, key=jax.random.key(0)))
    rng = np.random.default_rng(0)
    points, normals = np.asarray(drawn.points), np.asarray(drawn.normals)
    clean = PointCloud(points, normals)
    off = points + NOISE * rng.normal(size=points.shape)
    turned = normals + 20 * NOISE * rng.normal(size=points.shape)
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    pick = lambda keep: PointCloud(points[keep], normals[keep])
    above = np.asarray(mesh.vertices)[:, 1][np.asarray(mesh.faces)].min(axis=1) > 0
    part = keep_faces(mesh, jnp.asarray(above)).trim()
    on_part = jax.device_get(
        jg.meshes.sample_surface(part, MANY, key=jax.random.key(0))
    )
    yield "clean", clean, mesh
    yield "noisy", PointCloud(np.float32(off), np.float32(turned)), mesh
    yield "sparse", pick(rng.choice(MANY, FEW, replace=False)), mesh
    yield "partial", pick(normals[:, 2] > -np.sin(np.radians(20))), mesh
    yield "unoriented", PointCloud(points), mesh
    yield (
        "open",
        PointCloud(np.asarray(on_part.points), np.asarray(on_part.normals)),
        part,
    )


def by(method=None, **settings):
    """A method of `reconstruct`."""

    def run(cloud):
        resolution = 64 if len(cloud.points) <= FEW else 128
        return jg.reconstruct(
            cloud, resolution=resolution, method=method, **settings
        ).mesh

    return run


def network(cloud):
    """A network of its own, meshed at 128^3."""
    field = learning.NeuralField.fourier(key=jax.random.key(0))
    found = jg.fit_field(field, cloud, key=jax.random.key(1), throw=False)
    return _meshed(found.field, cloud, 128)


def stochastic(cloud):
    """The mean of the posterior, of at most 5 000 of the points."""
    chosen = np.random.default_rng(1).permutation(len(cloud.points))[:5000]
    some = PointCloud(cloud.points[chosen], cloud.normals[chosen])
    grid = Grid.around(some, resolution=64, padding=1.0)
    found = jax.jit(stochastic_poisson)(some, grid)
    return _cleaned(extract(found.values, grid, closed=True).mesh)


def _meshed(field, cloud, n):
    grid = Grid.around(cloud, resolution=n, padding=0.1)
    return _cleaned(extract(field, grid, closed=True).mesh)


def _cleaned(mesh):
    """Without specks, as `reconstruct` cleans."""
    return keep_faces(mesh, large_components(mesh, min_fraction=0.01)).trim()


METHODS = {
    "screened": by(ScreenedPoisson()),
    "poisson": by(Poisson()),
    "ssd": by(SSD()),
    "wavelet": by(Wavelet()),
    "stochastic": stochastic,
    "network": network,
    "trimmed": by(trim=0.3),
    "winding": by(orientation=WindingConsistency()),
    "as points": lambda cloud: (
        jg.pipelines.shape_as_points(cloud, key=jax.random.key(0)).mesh
    ),
}
# Those that make sense for a kind beside the common ones.
ONLY = {
    "trimmed": {"open", "partial"},
    "winding": {"unoriented"},
}


def fits(name, kind):
    if name in ONLY:
        return kind in ONLY[name]
    return not (kind == "unoriented" and name == "stochastic")


def main():
    """Print a line for every input and method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", default=os.environ.get("JAXGEOM_DATA"))
    parser.add_argument("--shapes", nargs="+", default=["horse", "bunny"])
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--kinds", nargs="+")
    options = parser.parse_args()
    for shape in options.shapes:
        path = pathlib.Path(options.data) / "meshes" / f"{shape}.ply"
        mesh = cases._unit(load_mesh(path))[0]
        for kind, cloud, truth in inputs(mesh):
            if options.kinds and kind not in options.kinds:
                continue
            for name in options.methods:
                if not fits(name, kind):
                    continue
                start = time.perf_counter()
                found = METHODS[name](cloud)
                seconds = time.perf_counter() - start
                error = accuracy.errors(found, truth)
                print(
                    f"{shape:8s} {kind:10s} {name:10s} cd {error['cd']:.2f} "
                    f"rms {error['rms']:.2f} {seconds:.1f} s",
                    flush=True,
                )


if __name__ == "__main__":
    main()
