"""Inference: 200 points of a statue, the classical road and the learned roads.

python experiments/museum/museum.py [folder]      reads what train.py wrote there
"""

import functools
import pathlib
import sys
import time

import figures
import jax
import jax.numpy as jnp
import numpy as np
from train import models

from jaxgeom import (
    TriangleMesh,
    fit_field,
    io,
    learning,
    meshes,
    reconstruct,
    render,
)
from jaxgeom.fields import Camera

POINTS = 200
CAMERA = Camera(position=(0.8, -1.3, 0.3))
KEY = jax.random.key(5)


def poisson(cloud):
    """Classical: screened Poisson and marching cubes."""
    return reconstruct(cloud, resolution=64).mesh


def one_network(cloud):
    """A network for this statue alone, from nothing."""
    net = learning.NeuralField.fourier(key=KEY)
    adam = learning.Adam(num_steps=1500)
    return mesh(fit_field(net, cloud, key=KEY, adam=adam).field)


def deep_sdf(cloud, *, family):
    """DeepSDF: the code of the trained family that explains the points."""
    return mesh(learning.encode(family.decoder, cloud, key=KEY).field)


def one_pass(cloud, *, pair):
    """The trained encoder reads the points and writes the code."""
    return mesh(pair.field(cloud))


def family_then_fit(cloud, *, family):
    """DeepSDF's answer as the start of a fit of all its weights to the points."""
    start = learning.encode(family.decoder, cloud, key=KEY).field
    adam = learning.Adam(num_steps=500, rate=3e-4)
    loss = learning.SurfaceLoss()
    return mesh(learning.train(start, loss, cloud, key=KEY, adam=adam).model)


def mesh(field):
    """Marching cubes on the same grid for all networks, specks removed."""
    return cleaned(figures.mesh_of(field).mesh).trim()


@jax.jit
def cleaned(found):
    """The mesh without parts of less than a twentieth of the largest."""
    return meshes.keep_faces(found, meshes.large_components(found, min_fraction=0.05))


def row(found, truth):
    """Chamfer, rms and largest distance in % of the height, normal consistency."""
    e = evaluated(padded(found), padded(truth))
    percent = lambda x: 100 * float(x) / (2 * figures.SCALE)
    errors = (percent(e.chamfer), percent(e.rms), percent(e.hausdorff))
    return (*errors, float(e.normal_consistency))


@jax.jit
def evaluated(found, truth):
    """The errors of one mesh against another, from 20 000 samples of each."""
    return meshes.evaluate(found, truth, key=KEY, num=20_000)


def padded(m, vertices=20000, faces=40000):
    """The mesh in arrays of one size, so that all are compared by one program."""
    v, f = len(m.vertices), len(m.faces)
    points = np.zeros((vertices, 3), np.float32)
    points[:v] = m.vertices
    corners = np.full((faces, 3), vertices, np.int32)
    corners[:f] = m.faces
    return TriangleMesh(points, corners, None, None, np.int32(v), np.int32(f))


def main(folder):
    """The table and the pictures."""
    family, pair = models()
    family = io.load_weights(folder / "family.npz", family)
    pair = io.load_weights(folder / "encoder.npz", pair)
    roads = {
        "screened Poisson": poisson,
        "one network": one_network,
        "DeepSDF code": functools.partial(deep_sdf, family=family),
        "encoder, one pass": functools.partial(one_pass, pair=pair),
        "code, then fit": functools.partial(family_then_fit, family=family),
    }
    held_out = [figures.figure(u) for u in figures.parameters(4, 999)]
    cases = {"four figures not trained on": held_out, "the statue": [figures.statue()]}
    for view, front in (("all around", False), ("the front only", True)):
        for title, bodies in cases.items():
            print(f"\n### {title}, {POINTS} points {view}\n")
            print("| road | Chamfer % | rms % | largest % | normals | seconds |")
            print("|---|---|---|---|---|---|")
            pictures = compare(roads, bodies, front)
            name = f"{title.split()[-1]}-{view.split()[-1]}.png".replace("on-", "new-")
            render.save_png(folder / name, render.side_by_side(pictures))


def compare(roads, bodies, front):
    """One line per road; the pictures of the last body."""
    truths = [figures.mesh_of(b).mesh.trim() for b in bodies]
    keys = jax.random.split(jax.random.key(42), len(bodies))
    clouds = [
        figures.scan(jax.tree.map(jnp.asarray, m), POINTS, k, front_only=front)
        for m, k in zip(truths, keys, strict=True)
    ]
    draw = lambda m: render.render_mesh(m, CAMERA, size=(300, 240))
    pictures = [
        draw(truths[-1]),
        render.render_cloud(clouds[-1], CAMERA, size=(300, 240)),
    ]
    for name, road in roads.items():
        road(clouds[0])  # compiled
        began = time.time()
        found = [road(cloud) for cloud in clouds]
        seconds = (time.time() - began) / len(clouds)
        scores = np.mean(
            [row(f, t) for f, t in zip(found, truths, strict=True)], axis=0
        )
        told = " | ".join(f"{x:.2f}" for x in scores[:3])
        print(f"| {name} | {told} | {scores[3]:.3f} | {seconds:.1f} |", flush=True)
        pictures.append(draw(found[-1]))
    return pictures


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else "."))
