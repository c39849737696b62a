"""How near the extractors come to sharp shapes, and to smooth ones (CPU).

    python experiments/isosurface/sharp.py --resolution 64
    python experiments/isosurface/sharp.py --picture sharp.png

Bodies with edges, turned at random, on a grid of three different spacings. Prints in
cells (the widest spacing): the distance of points on the edges of the body from the
mesh (mean, root mean square, largest), the distance of the mesh from the surface (mean,
largest), and in degrees the mean angle between faces and the surface. Then the order of
convergence on a torus. Needs open3d for the distances from points to a mesh.
"""

import argparse
import itertools

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom.fields import Box, Cylinder, Torus
from jaxgeom.isosurface import (
    AdaptiveDualContouring,
    Cubic,
    DualContouring,
    DualGridCubes,
    DualMarchingCubes,
    FlexiCubes,
    MarchingCubes,
    extract,
)
from jaxgeom.shapes import Grid
from jaxgeom.transforms import Rigid

# Given the width of a cell: octrees merge cells up to an error of 1/20 of it.
METHODS = {
    "marching cubes": lambda width: MarchingCubes(),
    "marching cubes, cubic": lambda width: MarchingCubes(placement=Cubic()),
    "dual marching cubes": lambda width: DualMarchingCubes(),
    "dual contouring": lambda width: DualContouring(),
    "dual contouring, octree": lambda width: AdaptiveDualContouring(width / 20),
    "dual grid": lambda width: DualGridCubes(),
    "dual grid, octree": lambda width: DualGridCubes(width / 20, levels=4),
    "FlexiCubes, weights zero": lambda width: FlexiCubes(),
}
UNIFORM = [name for name in METHODS if "octree" not in name]
HALF = np.array([0.5, 0.42, 0.56], np.float32)

PICTURED = [name for name in METHODS if name not in UNIFORM[1:2] + UNIFORM[-1:]]


def box():
    """A box."""
    return Box(HALF)


def csg():
    """A box with a hole: flat and round faces, straight and round edges."""
    return Box(HALF) - Cylinder(0.24, 0.9)


def octahedron(point):
    """An octahedron, no distance: its gradient has length sqrt(3)."""
    return jnp.sum(jnp.abs(point)) - 0.75


def gear(point):
    """A wheel with twelve teeth of straight flanks."""
    x, y, z = point
    angle = jnp.arctan2(y, jnp.where((x == 0) & (y == 0), 1.0, x))
    tooth = jnp.abs(jnp.mod(angle * 12 / (2 * jnp.pi), 1.0) - 0.5)
    outline = jnp.clip(0.55 + 0.4 * (tooth - 0.25), 0.5, 0.6)
    radius = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-12))
    return jnp.maximum(jnp.maximum(radius - outline, jnp.abs(z) - 0.3), 0.2 - radius)


BODIES = {
    "box": box(),
    "box less cylinder": csg(),
    "octahedron": octahedron,
    "gear": gear,
}


def placed(body, seed=3):
    """The body turned at random and moved."""
    q = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    q = (q * np.linalg.det(q)).astype(np.float32)
    back = Rigid(q, np.float32([0.021, -0.034, 0.013])).inverse()
    return lambda point: body(back(point))


def grid_of(n):
    """A grid of three different spacings."""
    low, high = np.array([-1.0, -1.1, -0.95]), np.array([1.0, 1.05, 0.98])
    spacing = (high - low) / (n - 1)
    return Grid(low.astype(np.float32), spacing.astype(np.float32), (n, n, n))


def box_edges(half, count=2000):
    """Points on the twelve edges of a box."""
    out, s = [], np.linspace(-1, 1, count)
    for axis, p, q in itertools.product(range(3), (-1, 1), (-1, 1)):
        points = np.empty((count, 3))
        points[:, axis] = s * half[axis]
        points[:, (axis + 1) % 3] = p * half[(axis + 1) % 3]
        points[:, (axis + 2) % 3] = q * half[(axis + 2) % 3]
        out.append(points)
    return np.concatenate(out)


def edges_of(name, count=2000):
    """Points on the edges of a body, where they have a formula."""
    if name == "box":
        return box_edges(HALF)
    if name == "box less cylinder":
        turn = np.linspace(0, 2 * np.pi, 6 * count)
        rims = [
            np.stack([0.24 * np.cos(turn), 0.24 * np.sin(turn), 0 * turn + z], axis=1)
            for z in (-HALF[2], HALF[2])
        ]
        return np.concatenate([box_edges(HALF), *rims])
    if name == "octahedron":
        s = np.linspace(0, 1, count)[:, None]
        tips = 0.75 * np.concatenate([np.eye(3), -np.eye(3)])
        pairs = [(a, b) for a, b in itertools.combinations(tips, 2) if (a + b).any()]
        return np.concatenate([a + s * (b - a) for a, b in pairs])
    return None


def samples(mesh, count=60000):
    """Points on the mesh, and the normals of their faces."""
    rng = np.random.default_rng(0)
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    weights = rng.dirichlet((1, 1, 1), count)
    points = np.einsum("nk,nkd->nd", weights, corners[face])
    return points.astype(np.float32), cross[face] / area[face, None]


def distances(mesh, points):
    """The distances of points from a mesh."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    vertices = np.asarray(mesh.vertices, np.float32)
    scene.add_triangles(vertices, np.asarray(mesh.faces).astype(np.uint32))
    return scene.compute_distance(np.asarray(points, np.float32)).numpy()


def report(name, body, grid):
    """One line per extractor."""
    field = placed(body)
    width = float(np.max(grid.spacing))
    edges = edges_of(name)
    if edges is not None:
        q = np.linalg.qr(np.random.default_rng(3).standard_normal((3, 3)))[0]
        edges = edges @ (q * np.linalg.det(q)).T + np.array([0.021, -0.034, 0.013])
    slopes = jax.jit(jax.vmap(jax.value_and_grad(field)))
    for label, method in METHODS.items():
        mesh = extract(field, grid, method=method(width)).mesh
        points, normals = samples(mesh)
        values, gradients = map(np.asarray, slopes(points))
        steep = np.linalg.norm(gradients, axis=1)
        off = np.abs(values) / steep / width
        cosine = np.sum(normals * gradients, axis=1) / steep
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1))).mean()
        line = f"| {name} | {label} | {mesh.faces.shape[0]} |"
        if edges is None:
            line += " | | |"
        else:
            d = distances(mesh, edges) / width
            line += f" {d.mean():.1e} | {np.sqrt((d**2).mean()):.1e} | {d.max():.1e} |"
        print(line + f" {off.mean():.1e} | {off.max():.1e} | {angle:.2f} |", flush=True)


def convergence():
    """The largest distance from a torus, and the order from one grid to the next."""
    field = placed(Torus(0.55, 0.25))
    for label in UNIFORM:
        errors = []
        for n in (32, 63, 125):
            mesh = extract(field, grid_of(n), method=METHODS[label](0)).mesh
            points = np.asarray(mesh.vertices)[np.asarray(mesh.faces)].mean(axis=1)
            errors.append(float(np.abs(jax.jit(jax.vmap(field))(points)).max()))
        orders = [np.log2(a / b) for a, b in itertools.pairwise(errors)]
        written = " | ".join(f"{x:.2e}" for x in errors)
        print(f"| {label} | {written} | {orders[0]:.2f}, {orders[1]:.2f} |", flush=True)


def picture(path, body, resolution):
    """The same body by all extractors, side by side, each with a closer look."""
    from matplotlib import pyplot as plt
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    field, grid = placed(body), grid_of(resolution)
    figure, axes = plt.subplots(
        2, 3, figsize=(12, 8.6), subplot_kw={"projection": "3d"}
    )
    width = float(np.max(grid.spacing))
    light = np.array([0.4, -0.5, 0.77])
    for axis, label in zip(axes.flat, PICTURED, strict=True):
        mesh = extract(field, grid, method=METHODS[label](width)).mesh
        corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals = cross / np.linalg.norm(cross, axis=1, keepdims=True)
        shade = 0.35 + 0.6 * np.clip(normals @ light, 0, 1)
        colors = shade[:, None] * np.array([0.75, 0.82, 0.95])
        axis.add_collection3d(
            Poly3DCollection(
                corners, facecolors=colors, edgecolors=0.6 * colors, lw=0.2
            )
        )
        axis.set(
            xlim=(-0.7, 0.7),
            ylim=(-0.7, 0.7),
            zlim=(-0.7, 0.7),
            title=f"{label}: {len(corners)} faces",
        )
        axis.set_box_aspect((1, 1, 1), zoom=1.5)
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main():
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--picture", help="write a picture here, and no tables")
    options = parser.parse_args()
    if options.picture:
        return picture(options.picture, BODIES["box less cylinder"], 24)
    print("| body | method | faces | edge mean | rms | max | off mean | max | angle |")
    for name, body in BODIES.items():
        report(name, body, grid_of(options.resolution))
    print("| torus: method | 32^3 | 63^3 | 125^3 | order |")
    convergence()


if __name__ == "__main__":
    main()
