"""Fit a mesh to points by gradient descent: FlexiCubes against marching cubes (CPU).

    python experiments/isosurface/fit.py --data $JAXGEOM_DATA

Both start from the signed distance of the same Poisson reconstruction of 30 000
oriented points, on the same grid, with the same loss and the same optimiser (Adam): the
squared distance of samples of the mesh from the tangent planes of the points, that of
points from the mesh, and the angle between their normals. What differs is what may
move: the values of the grid; for FlexiCubes also its weights. Prints in cells: the
Chamfer distance (mean of both directions), the distance of points on the edges of the
target from the mesh, and in degrees the mean angle of normals.
"""

import argparse
import pathlib
import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import Grid, PointCloud, TriangleMesh, reconstruct
from jaxgeom.fields import Box, Cylinder
from jaxgeom.io import load_mesh
from jaxgeom.isosurface import (
    Capacity,
    Centers,
    Diagonals,
    DualContouring,
    FlexiCubes,
    FlexiWeights,
    MarchingCubes,
    extract,
    flexicubes,
    marching_cubes,
)
from jaxgeom.meshes import sample_surface
from jaxgeom.neighbors import build, closest_on_mesh, knn, signed_distance
from jaxgeom.transforms import Rigid

HALF = np.array([0.32, 0.27, 0.36], np.float32)
RADIUS = 0.15
POINTS, SAMPLES = 30_000, 5_000


def part():
    """A box with a hole, turned: the target with edges, and points on these."""
    q = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
    place = Rigid((q * np.linalg.det(q)).astype(np.float32), np.zeros(3, np.float32))
    body = (Box(HALF) - Cylinder(RADIUS, 0.9)).transformed(place)
    grid = Grid(np.full(3, -0.6, np.float32), np.full(3, 0.006, np.float32), (201,) * 3)
    mesh = extract(body, grid, method=DualContouring()).mesh
    return mesh, np.asarray(place(edges().astype(np.float32)))


def edges(count=1000):
    """Points on the straight and the round edges of the part."""
    out, s = [], np.linspace(-1, 1, count)
    for axis in range(3):
        for p in (-1, 1):
            for q in (-1, 1):
                line = np.empty((count, 3))
                line[:, axis] = s * HALF[axis]
                line[:, (axis + 1) % 3] = p * HALF[(axis + 1) % 3]
                line[:, (axis + 2) % 3] = q * HALF[(axis + 2) % 3]
                out.append(line)
    turn = np.linspace(0, 2 * np.pi, 4 * count)
    for z in (-HALF[2], HALF[2]):
        rim = [RADIUS * np.cos(turn), RADIUS * np.sin(turn), 0 * turn + z]
        out.append(np.stack(rim, axis=1))
    return np.concatenate(out)


def fertility(folder):
    """The mesh of the statue, in a cube of side 1 about the origin."""
    mesh = load_mesh(pathlib.Path(folder) / "meshes" / "fertility.ply")
    vertices = np.asarray(mesh.vertices, np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    unit = (vertices - (low + high) / 2) / (high - low).max()
    return TriangleMesh(unit.astype(np.float32), np.asarray(mesh.faces)), None


def start_values(cloud, grid):
    """The signed distance of the reconstruction, in cells, at the nodes of the grid."""
    mesh = reconstruct(cloud, resolution=grid.shape[0]).mesh
    distance = jax.jit(lambda m, p: signed_distance(m, p).distances)
    nodes = np.asarray(grid.nodes()).reshape(-1, 3)
    return distance(mesh, nodes).reshape(grid.shape) / np.max(grid.spacing)


def mesh_of(parameters, grid, capacity, split):
    """The mesh of the parameters, and the regulariser of FlexiCubes."""
    if "weights" not in parameters:
        out = marching_cubes(
            parameters["values"], grid, capacity=capacity, normals=False
        )
        return out.mesh, 0.0
    out = flexicubes(
        parameters["values"],
        grid,
        parameters["weights"],
        capacity=capacity,
        split=split,
    )
    return out.extraction.mesh, jnp.mean(out.deviation)


def loss_of(parameters, key, cloud, index, grid, capacity):
    """Distances both ways in cells, the angle of normals, and the regulariser."""
    mesh, deviation = mesh_of(parameters, grid, capacity, Centers())
    width = jnp.max(grid.spacing)
    one, two = jax.random.split(key)
    drawn = sample_surface(mesh, SAMPLES, key=one)
    near = knn(index, jax.lax.stop_gradient(drawn.points), 1).indices[:, 0]
    normals = cloud.normals[near]
    off = jnp.sum(normals * (drawn.points - cloud.points[near]), axis=1) / width
    rows = jax.random.choice(two, POINTS, (SAMPLES,), replace=False)
    there = closest_on_mesh(mesh, cloud.points[rows])
    back = there.distances / width
    corners = mesh.triangles()[there.faces]
    cross = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = jnp.linalg.norm(cross, axis=1)
    cosine = jnp.sum(cross * cloud.normals[rows], axis=1) / jnp.maximum(length, 1e-12)
    # A sample beyond an edge is far from the plane of any other part.
    near_loss = jnp.mean(jnp.minimum(off**2, 1.0)) + jnp.mean(back**2)
    return near_loss + 0.05 * jnp.mean(1 - cosine) + 0.2 * deviation / width


def adam(gradient, state, parameters, rate, count):
    """One step of Adam (Kingma and Ba 2015)."""
    first, second = state
    first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, gradient)
    second = jax.tree.map(lambda v, g: 0.99 * v + 0.01 * g * g, second, gradient)
    scale = jnp.sqrt(1 - 0.99**count) / (1 - 0.9**count)
    move = lambda p, m, v: p - rate * scale * m / (jnp.sqrt(v) + 1e-8)
    return jax.tree.map(move, parameters, first, second), (first, second)


def fit(parameters, cloud, grid, capacity, steps, rate=0.02):
    """The parameters after `steps` of gradient descent, and the seconds they took."""
    index = build(cloud.points)

    @jax.jit
    def step(parameters, state, key, count):
        args = (key, cloud, index, grid, capacity)
        loss, slope = jax.value_and_grad(loss_of)(parameters, *args)
        falling = rate * 0.1 ** (count / steps)
        return *adam(slope, state, parameters, falling, count), loss

    zero = jax.tree.map(jnp.zeros_like, parameters)
    state, begin = (zero, zero), time.perf_counter()
    for count in range(1, steps + 1):
        key = jax.random.key(count)
        parameters, state, loss = step(parameters, state, key, float(count))
        if count == 1 or count % 50 == 0:
            passed = time.perf_counter() - begin
            print(
                f"    step {count}: loss {float(loss):.5f}, {passed:.0f} s", flush=True
            )
    return parameters, time.perf_counter() - begin


def errors(mesh, target, edge_points, width):
    """Chamfer distance, edge distance and angle of normals of a mesh."""
    ours = sample_surface(mesh, 100_000, key=jax.random.key(1))
    theirs = sample_surface(target, 100_000, key=jax.random.key(2))
    there = closest_on_mesh(target, ours.points)
    back = closest_on_mesh(mesh, theirs.points)
    chamfer = (np.mean(there.distances) + np.mean(back.distances)) / 2 / width
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)[back.faces]]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    cross /= np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-20)
    cosine = np.clip(np.sum(cross * np.asarray(theirs.normals), axis=1), -1, 1)
    angle = np.degrees(np.arccos(cosine)).mean()
    edge = np.nan
    if edge_points is not None:
        edge = float(np.mean(closest_on_mesh(mesh, edge_points).distances)) / width
    return chamfer, edge, angle


def run(name, target, edge_points, options):
    """Both fits of one target: a line each, and the meshes."""
    drawn = sample_surface(target, POINTS, key=jax.random.key(0))
    cloud = PointCloud(drawn.points, drawn.normals)
    n = options.resolution
    spacing = np.full(3, 1.16 / (n - 1), np.float32)
    grid = Grid(np.full(3, -0.58, np.float32), spacing, (n,) * 3)
    values, width = start_values(cloud, grid), float(spacing[0])
    vertices = 4 * int(MarchingCubes().measure(values).vertices)
    small = Capacity.holding(vertices // 3, 2 * vertices // 3, vertices // 3)
    large = Capacity(vertices, 2 * vertices, vertices)
    weights = FlexiWeights.zeros(grid.shape, values.dtype)
    starts = {
        "marching cubes": ({"values": values}, small),
        "FlexiCubes": ({"values": values, "weights": weights}, large),
    }
    meshes = {}
    for label, (parameters, capacity) in starts.items():
        fitted, seconds = fit(parameters, cloud, grid, capacity, options.steps)
        method = MarchingCubes()
        if "weights" in fitted:
            method = FlexiCubes(fitted["weights"], Diagonals())
        for stage, p, how in (
            ("start", parameters["values"], MarchingCubes()),
            ("fitted", fitted["values"], method),
        ):
            mesh = extract(p, grid, method=how).mesh
            chamfer, edge, angle = errors(mesh, target, edge_points, width)
            print(
                f"| {name} | {label}, {stage} | {mesh.faces.shape[0]} | {chamfer:.4f} "
                f"| {edge:.4f} | {angle:.2f} | {seconds:.0f} |",
                flush=True,
            )
        meshes[label] = mesh
    return meshes


def main():
    """Print the table, and draw the part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", help="the folder of real scans, for fertility")
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--only", choices=("part", "fertility"))
    options = parser.parse_args()
    print("| target | method | faces | Chamfer | edge | angle | s |")
    if options.only != "fertility":
        run("part", *part(), options)
    if options.data and options.only != "part":
        run("fertility", *fertility(options.data), options)


if __name__ == "__main__":
    main()
