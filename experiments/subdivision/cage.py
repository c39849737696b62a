"""What shapes are horses: a coarse control mesh fitted to points, and its picture.

    JAXGEOM_DATA=... python experiments/subdivision/cage.py cage.png

The cage is a coarse reconstruction of the same points; it is then moved so that its
limit surface fits them.
"""

import os
import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import RESULTS, PointCloud, TriangleMesh, io, reconstruct, render
from jaxgeom.meshes import vertex_normals
from jaxgeom.subdivision import fit_control_mesh

POINTS, RESOLUTION, SIZE = 20_000, 24, (480, 400)


def scan(name):
    """Points of a mesh with its normals, on unit diagonal, z up."""
    path = pathlib.Path(os.environ["JAXGEOM_DATA"]) / "meshes" / f"{name}.ply"
    mesh = io.load_mesh(path)
    pick = np.random.default_rng(0).permutation(mesh.vertices.shape[0])[:POINTS]
    points = np.asarray(mesh.vertices)
    low, high = points.min(axis=0), points.max(axis=0)
    points = (points - (low + high) / 2) / np.linalg.norm(high - low)
    normals = np.asarray(vertex_normals(mesh))
    return PointCloud(np.float32(points[pick]), np.float32(normals[pick]))


def flat(mesh):
    """The mesh with corners of its own for every face, for flat shading."""
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    return TriangleMesh(corners.reshape(-1, 3), faces, np.repeat(normals, 3, axis=0))


def report(name, fit, seconds):
    rms = np.asarray(fit.rms)
    last = int(fit.steps)
    print(f"{name}: cage {fit.cage.vertices.shape[0]} vertices,", end=" ")
    print(f"{fit.cage.faces.shape[0]} faces; {last} steps, {seconds:.1f} s")
    print(f"  rms / diagonal {rms[0]:.2e} -> {rms[last]:.2e}", _word(fit.result))


def _word(result):
    return "converged" if result == RESULTS.successful else "stopped at max_steps"


def fits(name, resolution):
    """The fits of one scan, by smoothness."""
    cloud = scan(name)
    cage = reconstruct(cloud, resolution=resolution).mesh
    found = {}
    for smoothness in (1e-2, 1e-3, 1e-4):
        start = time.perf_counter()
        fit = fit_control_mesh(cloud, cage, smoothness=smoothness)
        jax.block_until_ready(fit.rms)
        report(f"{name}, smoothness {smoothness:g}", fit, time.perf_counter() - start)
        found[smoothness] = fit
    return cloud, found


def main(path):
    fits("bunny", 16)
    cloud, found = fits("horse", 24)
    best = found[1e-3]
    camera = render.Camera(jnp.array([1.7, 0.5, 0.3]), jnp.zeros(3))
    pictures = [
        render.render_cloud(cloud, camera, size=SIZE, radius=0.004),
        render.render_mesh(flat(best.cage), camera, size=SIZE),
        render.render_mesh(best.surface, camera, size=SIZE),
    ]
    render.save_png(path, render.side_by_side(pictures))


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "cage.png")
