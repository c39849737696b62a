"""The shapes and scans of the comparison: points with normals, and the true mesh.

Everything is moved into the unit box of the true mesh (longest side 1). Samples are
uniform by area with the normals of their faces; noise is Gaussian, in units of the box.
"""

import dataclasses
import pathlib

import jax
import numpy as np

from jaxgeom.io import load_cloud, load_mesh
from jaxgeom.meshes import sample_surface
from jaxgeom.shapes import PointCloud, TriangleMesh


@dataclasses.dataclass
class Case:
    """One input with its truth (None where there is none) and the size of the grid."""

    name: str
    cloud: PointCloud
    truth: TriangleMesh | None
    depth: int
    euler: int | None = None
    trim: float | None = None


def load(folder: str, names: list[str]):
    """The cases of the given names, one at a time."""
    for name in names:
        yield CASES[name](pathlib.Path(folder))


def _unit(mesh):
    vertices = np.asarray(mesh.vertices, np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    center, side = (low + high) / 2, (high - low).max()
    unit = ((vertices - center) / side).astype(np.float32)
    return TriangleMesh(unit, np.asarray(mesh.faces)), center, side


def _sampled(name, shape, num, depth, euler, noise=0.0, trim=None):
    def make(folder):
        mesh, _, _ = _unit(load_mesh(folder / "meshes" / f"{shape}.ply"))
        drawn = sample_surface(mesh, num, key=jax.random.key(0))
        rng = np.random.default_rng(0)
        points = np.asarray(drawn.points) + noise * rng.normal(size=(num, 3))
        # 20 times the noise of the points is 0.1 on the normals at noise 0.005.
        normals = np.asarray(drawn.normals) + 20 * noise * rng.normal(size=(num, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        cloud = PointCloud(points.astype(np.float32), normals.astype(np.float32))
        return Case(name, cloud, mesh, depth, euler, trim)

    return make


def _scanned(name, depth, euler):
    def make(folder):
        benchmark = folder / "benchmark"
        mesh, center, side = _unit(load_mesh(benchmark / f"{name}_gt.ply"))
        scan = load_cloud(benchmark / f"{name}_scan.ply")
        points = (np.asarray(scan.points, np.float64) - center) / side
        cloud = PointCloud(points.astype(np.float32), np.asarray(scan.normals))
        return Case(name, cloud, mesh, depth, euler)

    return make


CASES = {
    "nefertiti-7": _sampled("nefertiti-7", "nefertiti", 100_000, 7, 2),
    "nefertiti-8": _sampled("nefertiti-8", "nefertiti", 100_000, 8, 2),
    "nefertiti-noisy": _sampled("nefertiti-noisy", "nefertiti", 100_000, 7, 2, 0.005),
    "anchor": _scanned("anchor", 7, -6),
    "dc": _scanned("dc", 7, -14),
    "armadillo": _sampled("armadillo", "armadillo", 50_000, 7, 2),
    "horse": _sampled("horse", "horse", 50_000, 7, 2),
    "bunny": _sampled("bunny", "bunny", 50_000, 7, 2),
    "fertility": _sampled("fertility", "fertility", 50_000, 7, -6),
    "falcon-open": _sampled("falcon-open", "falcon_open", 50_000, 7, 1, 0.0, 0.3),
    "statue-200": _sampled("statue-200", "nefertiti", 200, 6, 2),
}
