"""Normals and surfaces from bare points: share of right normals, scans, a picture.

    JAXGEOM_DATA=... python experiments/reconstruction/unoriented.py --picture out.png

Right: a positive product with the normal of the face that the sample came from. Open3D
(16 neighbors, then `orient_normals_consistent_tangent_plane(16)`) gets the sign of the
whole cloud for free, since it does not know inside from outside. Real scans have no
true normals: there the reconstructed mesh is described, with the median distance of the
points to it in thousandths of the longest side. The points of the raw bunny scan must
face the scanner, which looks along -z.
"""

import argparse
import os
import pathlib
import time

import equinox as eqx
import jax.numpy as jnp
import methods
import numpy as np
import open3d as o3d
import trimesh

import jaxgeom as jg
from jaxgeom.io import load_cloud
from jaxgeom.meshes import topology
from jaxgeom.normals import LocalPlanes, WindingConsistency
from jaxgeom.pipelines import IteratedPoisson
from jaxgeom.render import save_png, side_by_side
from jaxgeom.shapes import PointCloud

METHODS = {
    "planes": LocalPlanes(),
    "winding-64, k=None": WindingConsistency(resolution=64, levels=2, k=None),
    "winding-128, k=None": WindingConsistency(k=None),
    "winding-128": WindingConsistency(),
    "iterated-64": IteratedPoisson(),
    "iterated-128": IteratedPoisson(
        WindingConsistency(resolution=64, levels=2), resolution=128
    ),
}


@eqx.filter_jit
def _oriented(method, cloud):
    return method(cloud).normals


def shapes(folder):
    """Name, points [n, 3] and true normals of sampled closed meshes."""
    for name in ("armadillo", "horse"):
        mesh = trimesh.load(folder / "meshes" / f"{name}.ply", process=False)
        yield name, *_sampled(mesh, 50_000)
    for share in (0.05, 0.03, 0.02):
        mesh = trimesh.creation.box((1.0, 0.7, share))
        yield f"plate {share}", *_sampled(mesh, 20_000)
    for share in (0.05, 0.03):
        outer = trimesh.creation.icosphere(subdivisions=5, radius=0.5)
        inner = trimesh.creation.icosphere(subdivisions=5, radius=0.5 - share)
        inner.invert()
        mesh = trimesh.util.concatenate([outer, inner])
        yield f"shell {share}", *_sampled(mesh, 30_000)
    ring = trimesh.creation.torus(0.48, 0.02, major_sections=96)
    yield "wire 0.04", *_sampled(ring, 10_000)


def _sampled(mesh, num):
    points, faces = trimesh.sample.sample_surface(mesh, num, seed=0)
    return points.astype(np.float32), mesh.face_normals[faces]


def open3d(points, truth):
    """Normals of Open3D, turned as a whole to the better side."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.astype(float)))
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(16))
    cloud.orient_normals_consistent_tangent_plane(16)
    normals = np.asarray(cloud.normals)
    right = np.mean(np.sum(normals * truth, axis=1) > 0)
    return normals if right > 0.5 else -normals


def share_line(shape, name, normals, truth, seconds):
    """One line of the table of shares."""
    cosine = np.clip(np.sum(np.asarray(normals) * truth, axis=1), -1, 1)
    print(
        f"{shape:14s} {name:18s} right {100 * np.mean(cosine > 0):6.2f} % mean angle "
        f"{np.degrees(np.mean(np.arccos(cosine))):5.1f} deg {seconds:.1f} s",
        flush=True,
    )


def shares(folder, names, only):
    """The table of shares of right normals."""
    for shape, points, truth in shapes(folder):
        if only and shape not in only:
            continue
        for name in names:
            start = time.perf_counter()
            normals = _oriented(METHODS[name], PointCloud(jnp.asarray(points)))
            normals = np.asarray(normals)
            share_line(shape, name, normals, truth, time.perf_counter() - start)
        start = time.perf_counter()
        normals = open3d(points, truth)
        share_line(shape, "open3d", normals, truth, time.perf_counter() - start)


def scans(folder):
    """Name, points and the side that the camera looks from."""
    files = {
        "distcap": ("distcap_scan", (1, 0.4, 0.6)),
        "woodfish": ("ipsr_woodfish", (0.3, 0.4, 1)),
        "armadillo": ("wnnc_armadillo_40000", (0.3, 0.3, -1)),
    }
    for name, (file, side) in files.items():
        cloud = load_cloud(folder / "scans" / f"{file}.ply")
        yield name, np.asarray(cloud.points), side
    raw = np.load(folder / "registration" / "stanford_bunny" / "bunny_scans.npz")
    yield "bunny scan", raw["bun000_xyz"], (0.3, 0.3, 1)


def surfaces(folder, names, resolution):
    """Reconstruct the scans; the pictures, one row a scan."""
    rows = []
    for scan, points, side in scans(folder):
        views = []
        for name in names:
            start = time.perf_counter()
            out = jg.reconstruct(
                points, resolution=resolution, orientation=METHODS[name]
            )
            seconds = time.perf_counter() - start
            facts = topology(out.mesh)
            text = (
                f"{scan:10s} {name:18s} euler {int(facts.euler)} bodies "
                f"{int(facts.num_components)} median distance "
                f"{_distance(points, out.mesh):.2f} {seconds:.1f} s {out.notes}"
            )
            if scan == "bunny scan":
                normals = _oriented(METHODS[name], PointCloud(jnp.asarray(points)))
                facing = float(np.mean(np.asarray(normals)[:, 2] > 0))
                text += f" facing {100 * facing:.2f} %"
            print(text, flush=True)
            views.append(_view(points, out.mesh, side))
        rows.append(side_by_side(views))
    return np.concatenate(rows, axis=0)


def _distance(points, mesh):
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        np.ascontiguousarray(mesh.vertices, np.float32),
        np.ascontiguousarray(mesh.faces, np.uint32),
    )
    found = scene.compute_distance(np.ascontiguousarray(points, np.float32)).numpy()
    return 1e3 * np.median(found) / np.ptp(points, axis=0).max()


def _view(points, mesh, side):
    low, high = points.min(axis=0), points.max(axis=0)
    center, size = (low + high) / 2, (high - low).max()
    unit = eqx.tree_at(
        lambda m: m.vertices,
        mesh,
        ((np.asarray(mesh.vertices) - center) / size).astype(np.float32),
    )
    return methods.view(unit, side)


def main():
    """Print the tables, write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", default=os.environ["JAXGEOM_DATA"])
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--shapes", nargs="*")
    parser.add_argument("--picture", help="reconstruct the scans, and draw them here")
    parser.add_argument("--resolution", type=int, default=128)
    options = parser.parse_args()
    folder = pathlib.Path(options.data)
    if options.picture:
        save_png(options.picture, surfaces(folder, options.methods, options.resolution))
    else:
        shares(folder, options.methods, options.shapes)


if __name__ == "__main__":
    main()
