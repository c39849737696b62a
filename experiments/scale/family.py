"""One template laid on many scans of a family, and the shape space of the results.

    python -m experiments.scale.family family.png [--scans 64] [--peers 3]

Scans are flasks of throughput.py, three times as different and seen from all sides:
1 500 to 3 000 points with normals and noise of 0.2 % of the height, no correspondences.
The template, a mesh of the mean flask, is deformed onto each by `nonrigid_many`; the
registered meshes share their faces, so that a shape space is their mean and principal
components. Prints the distance of the registered vertices to the fields that the scans
were made from, the share of the variance in the first components, and how well
components of one half describe the other half; the peer is a loop over trimesh's
optimal-step registration. Draws scans, registered meshes (one color is one place of the
template), and the first components. Run it from the root of the repository.
"""

import argparse
import os
import time

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from trimesh.registration import nricp_amberg

from experiments.scale.meshes import HEIGHT, offsets
from experiments.scale.throughput import NOISE, NUMBERS, flask, surface
from jaxgeom import Grid, PointCloud, TriangleMesh, nonrigid_many, render, stack
from jaxgeom._core import name_of
from jaxgeom.isosurface import DualContouring, extract

RESOLUTION, SIZE, COMPONENTS, SPREAD = 40, (240, 200), 3, 3.0


def make(scans):
    """The numbers of the flasks, and a cloud of each."""
    rng = np.random.default_rng(3)
    numbers = SPREAD * rng.uniform(-1, 1, (scans, NUMBERS)).astype(np.float32)
    clouds = []
    for i, u in enumerate(numbers):
        found = map(np.asarray, surface(u, jax.random.key(1000 + i)))
        points, normals, good = found
        pick = np.flatnonzero(good)[: rng.integers(1500, 3000)]
        noise = NOISE * HEIGHT * rng.normal(size=(len(pick), 3))
        points, normals = np.float32(points[pick] + noise), normals[pick]
        clouds.append(PointCloud(points, normals))
    return numbers, clouds


def template():
    """A mesh of the mean flask, of about 2 500 vertices."""
    box = PointCloud(jnp.array([[-0.3, -0.25, -0.4], [0.5, 0.25, 0.65]]))
    grid = Grid.around(box, resolution=RESOLUTION)
    return extract(flask(jnp.zeros(NUMBERS)), grid, method=DualContouring()).mesh


def registered(mesh, clouds):
    """The vertices [b, v, 3] of the registered meshes; prints rate and statuses."""
    batch = stack(clouds)
    for word in ("first call", "again"):
        start = time.perf_counter()
        found = nonrigid_many(mesh, batch)
        seconds = time.perf_counter() - start
        print(f"nonrigid_many, {word}: {len(clouds) / seconds:.2f} scans a second")
    each = [jax.tree.map(lambda x, i=i: x[i], found.result) for i in range(len(clouds))]
    names = [name_of(result) for result in each]
    print(
        "  " + ", ".join(f"{names.count(name)} {name}" for name in sorted(set(names)))
    )
    return found.mesh.vertices


def by_trimesh(mesh, clouds):
    """The same by trimesh, one after the other."""
    body = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    steps = [[stiffness, 0, 0, 10] for stiffness in (10, 5, 2, 0.8, 0.35, 0.2)]
    found, start = [], time.perf_counter()
    for cloud in clouds:
        target = trimesh.PointCloud(cloud.points)
        found.append(nricp_amberg(body, target, steps=steps, use_faces=False))
    rate = len(clouds) / (time.perf_counter() - start)
    print(f"loop over trimesh: {rate:.3f} scans a second")
    return np.array(found)


def report(name, vertices, numbers):
    """How far registered vertices are from the surfaces, in percent of the height."""
    pairs = zip(numbers, vertices, strict=True)
    gaps = 100 * np.concatenate([np.asarray(offsets(*pair)) for pair in pairs])
    middle, most = np.median(gaps), np.quantile(gaps, 0.99)
    print(f"{name}: distance median {middle:.2f} %, 99 % {most:.2f} %")


def shape_space(vertices):
    """The mean [3 v], the components [k, 3 v] and the deviation along each."""
    rows = vertices.reshape(len(vertices), -1)
    mean = rows.mean(axis=0)
    _, sizes, components = np.linalg.svd(rows - mean, full_matrices=False)
    return mean, components, sizes / np.sqrt(len(rows) - 1)


def report_space(vertices):
    """How few numbers describe the family."""
    _, _, deviations = shape_space(vertices)
    share = 100 * np.cumsum(deviations**2) / np.sum(deviations**2)
    print("variance of the first 1, 2, 4, 8, 12 components:", end=" ")
    print(", ".join(f"{share[k - 1]:.1f}" for k in (1, 2, 4, 8, 12)), "%")
    half = len(vertices) // 2
    mean, components, _ = shape_space(vertices[:half])
    rest = vertices[half:].reshape(len(vertices) - half, -1) - mean
    for k in (0, 2, 4, 8, 12):
        left = rest - rest @ components[:k].T @ components[:k]
        size = np.linalg.norm(left.reshape(len(left), -1, 3), axis=-1)
        print(f"  the other half by {k} components: {100 * size.mean() / HEIGHT:.2f} %")


def picture(path, mesh, clouds, vertices):
    camera = render.Camera(jnp.array([0.9, -1.5, 0.6]), jnp.array([0.05, 0.0, 0.1]))
    low, high = np.min(mesh.vertices, 0), np.max(mesh.vertices, 0)
    painted = {"colors": 0.15 + 0.8 * (np.asarray(mesh.vertices) - low) / (high - low)}
    draw = lambda v: render.render_mesh(
        TriangleMesh(v, mesh.faces, attributes=painted), camera, size=SIZE
    )
    mean, components, deviations = shape_space(vertices)
    moved = [
        (mean + sign * 2 * deviations[k] * components[k]).reshape(-1, 3)
        for k in range(COMPONENTS)
        for sign in (-1, 1)
    ]
    rows = [
        [
            render.render_cloud(cloud, camera, size=SIZE, radius=0.006)
            for cloud in clouds[: 2 * COMPONENTS]
        ],
        [draw(v) for v in vertices[: 2 * COMPONENTS]],
        [draw(v.astype(np.float32)) for v in moved],
    ]
    render.save_png(path, np.concatenate([render.side_by_side(row) for row in rows]))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture")
    parser.add_argument("--scans", type=int, default=64)
    parser.add_argument("--peers", type=int, default=3)
    args = parser.parse_args()
    # As `jaxgeom batch` does.
    jax.config.update("jax_num_cpu_devices", len(os.sched_getaffinity(0)))
    numbers, clouds = make(args.scans)
    mesh = template()
    print(f"template of {len(mesh.vertices)} vertices, {args.scans} scans")
    report(
        "template", np.repeat(np.asarray(mesh.vertices)[None], args.scans, 0), numbers
    )
    vertices = registered(mesh, clouds)
    report("nonrigid_many", vertices, numbers)
    report_space(vertices)
    if args.peers:
        report("trimesh", by_trimesh(mesh, clouds[: args.peers]), numbers[: args.peers])
        report("nonrigid_many, the same", vertices[: args.peers], numbers[: args.peers])
    picture(args.picture, mesh, clouds, vertices)


if __name__ == "__main__":
    main()
