"""NDF: the falcon that is open below, and a garment: dense points and a mesh.

JAXGEOM_DATA=... python experiments/learning/unsigned.py [folder for pictures]
"""

import os
import pathlib
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import Grid, TriangleMesh, io, learning, meshes, render
from jaxgeom.fields import Camera

KEY = jax.random.key(0)
NODES = 96
GRID = Grid(
    jnp.full(3, -0.55, jnp.float32), jnp.full(3, 1.1 / (NODES - 1)), (NODES,) * 3
)


def falcon():
    """`falcon_open`, its longest side made 1."""
    path = pathlib.Path(os.environ["JAXGEOM_DATA"]) / "meshes" / "falcon_open.ply"
    mesh = io.load_mesh(path)
    vertices = np.asarray(mesh.vertices, np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    unit = (vertices - (low + high) / 2) / (high - low).max()
    return TriangleMesh(jnp.asarray(unit, jnp.float32), jnp.asarray(mesh.faces))


def skirt():
    """A pleated skirt: a sheet with a waist above and a hem below."""
    u, v = np.meshgrid(
        np.linspace(0, 1, 193)[:-1], np.linspace(0, 1, 64), indexing="ij"
    )
    angle, radius = 2 * np.pi * u, 0.16 + 0.24 * v
    radius = radius + 0.045 * v * np.sin(9 * angle)
    points = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), 0.35 - 0.7 * v], axis=-1
    )
    index = np.arange(u.size).reshape(u.shape)
    right = np.roll(index, -1, axis=0)
    a, b, c, d = index[:, :-1], right[:, :-1], right[:, 1:], index[:, 1:]
    faces = np.concatenate(
        [np.stack(t, -1).reshape(-1, 3) for t in ((a, c, b), (a, d, c))]
    )
    return TriangleMesh(
        jnp.asarray(points.reshape(-1, 3), jnp.float32), jnp.asarray(faces, jnp.int32)
    )


def main(folder):
    """A line of figures and a picture for each sheet."""
    for name, truth in (("falcon_open", falcon()), ("skirt", skirt())):
        learn = jax.jit(
            lambda m, k: learning.unsigned_samples(
                m, 200_000, key=k, spreads=(0.005, 0.03)
            )
        )
        samples = learn(truth, jax.random.key(1))
        net = learning.Unsigned(
            learning.NeuralField.siren(key=KEY, width=96, frequency=30.0)
        )
        loss = learning.DistanceLoss(clamp=0.1, batch=4096)
        began = time.time()
        adam = learning.Adam(num_steps=1500, rate=1e-3)
        out = learning.train(net, loss, samples, key=KEY, adam=adam)
        print(f"\n{name}: trained in {time.time() - began:.0f} s")
        report(name, out.model, truth, folder)


def report(name, field, truth, folder):
    """Errors of the field, of its dense points and of its mesh."""
    draw = jax.jit(
        lambda f, k: learning.dense_points(f, GRID, 30_000, key=k, tolerance=0.003)
    )
    dense = draw(field, jax.random.key(3)).cloud.trim()
    away = meshes.point_to_mesh(jnp.asarray(dense.points), truth)
    print(
        f"  dense points: {len(dense.points)}, mean {float(away.mean):.5f}, "
        f"rms {float(away.rms):.5f}, largest {float(away.max):.4f}"
    )
    began = time.time()
    found = jax.tree.map(jnp.asarray, learning.open_surface(field, GRID).mesh)
    keep = meshes.large_components(found, min_fraction=0.05)
    found = meshes.keep_faces(found, keep).trim()
    mesh = jax.tree.map(jnp.asarray, found)
    seconds = time.time() - began
    e = meshes.evaluate(mesh, truth, key=KEY, num=50_000)
    for label, m in (("mesh", mesh), ("truth", truth)):
        t = meshes.topology(m)
        print(
            f"  {label}: {m.faces.shape[0]} faces, {int(t.num_components)} parts, "
            f"{int(t.boundary_loops)} rims, {int(t.boundary_edges)} edges on them, "
            f"{int(t.nonmanifold_edges)} edges with more than two faces"
        )
    print(
        f"  mesh in {seconds:.1f} s: rms {float(e.rms):.5f} "
        f"(to the truth {float(e.rms_to_reference):.5f}, from it "
        f"{float(e.rms_from_reference):.5f}), largest {float(e.hausdorff):.4f}, "
        f"normals {float(e.normal_consistency):.3f}"
    )
    size = {"size": (320, 300)}
    camera = Camera(position=(1.0, -1.2, -0.6))
    pictures = [
        render.render_mesh(truth, camera, **size),
        render.render_cloud(jax.tree.map(jnp.asarray, dense), camera, **size),
        render.render_mesh(found, camera, **size),
    ]
    render.save_png(folder / f"{name}.png", render.side_by_side(pictures))


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else "."))
