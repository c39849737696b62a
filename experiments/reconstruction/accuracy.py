"""How near reconstructions come to the truth, beside Open3D and PyMeshLab.

    JAXGEOM_DATA=... python experiments/reconstruction/accuracy.py --pymeshlab

Every method gets the same points with its default settings and a grid of the same
resolution. RMS: exact distances between samples of each surface and the other surface
(by Open3D's ray casting scene), in thousandths of the longest side; CD: CD-L1 of
100 000 samples on each (by scipy's k-d tree), about 1.9 for a surface and itself.
`--screening 2 8` adds rows with given screening weights.
"""

import argparse
import os
import sys
import time

import jax
import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

import jaxgeom as jg
from jaxgeom.meshes import sample_surface, topology
from jaxgeom.reconstruction import ScreenedPoisson

sys.path.insert(0, os.path.dirname(__file__))
import cases


def ours(case, screening=None):
    """The door with its defaults (or a given screening weight)."""
    method = None if screening is None else ScreenedPoisson(screening=screening)
    out = jg.reconstruct(
        case.cloud, resolution=2**case.depth, method=method, trim=case.trim
    )
    stats = out.stats
    note = f"alpha {float(stats.screening):.2f} noise {float(stats.noise):.1e}"
    return out.mesh, f"{note} steps {int(stats.steps)}"


def open3d(case):
    """Open3D's Poisson at the same depth."""
    cloud = o3d.geometry.PointCloud(
        o3d.utility.Vector3dVector(np.asarray(case.cloud.points, np.float64))
    )
    normals = np.asarray(case.cloud.normals, np.float64)
    cloud.normals = o3d.utility.Vector3dVector(normals)
    mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=case.depth, n_threads=2
    )
    return _mesh(np.asarray(mesh.vertices), np.asarray(mesh.triangles)), ""


def pymeshlab(case):
    """MeshLab's screened Poisson at depth 8."""
    import pymeshlab as ml

    session = ml.MeshSet()
    points = np.asarray(case.cloud.points, np.float64)
    normals = np.asarray(case.cloud.normals, np.float64)
    session.add_mesh(ml.Mesh(points, v_normals_matrix=normals))
    session.generate_surface_reconstruction_screened_poisson(depth=8, threads=2)
    mesh = session.current_mesh()
    return _mesh(mesh.vertex_matrix(), mesh.face_matrix()), "depth 8"


def _mesh(vertices, faces):
    return jg.TriangleMesh(vertices.astype(np.float32), faces.astype(np.int32))


def errors(mesh, truth):
    """RMS, Hausdorff, CD-L1 (thousandths), F-score at 0.01 and normal consistency."""
    ours, true = (_samples(m, i) for i, m in enumerate((mesh, truth)))
    exact = [_to_mesh(ours.points, truth), _to_mesh(true.points, mesh)]
    near = [_to_samples(ours, true), _to_samples(true, ours)]
    mean = lambda pair: float(np.mean([np.mean(x) for x in pair]))
    shares = [np.mean(distance <= 0.01) for distance, _ in near]
    return {
        "rms": 1e3 * mean([d**2 for d in exact]) ** 0.5,
        "haus": 1e3 * max(d.max() for d in exact),
        "cd": 1e3 * mean([distance for distance, _ in near]),
        "f": 2 * shares[0] * shares[1] / sum(shares),
        "nc": mean([cosine for _, cosine in near]),
    }


def _samples(mesh, seed):
    return jax.device_get(sample_surface(mesh, 100_000, key=jax.random.key(seed)))


def _to_mesh(points, mesh):
    scene = o3d.t.geometry.RaycastingScene()
    vertices = np.ascontiguousarray(mesh.vertices, np.float32)
    scene.add_triangles(vertices, np.ascontiguousarray(mesh.faces, np.uint32))
    found = scene.compute_distance(np.ascontiguousarray(points, np.float32)).numpy()
    return found.astype(np.float64)


def _to_samples(a, b):
    distance, index = cKDTree(b.points).query(a.points)
    return distance, np.abs(np.sum(a.normals * b.normals[index], axis=1))


def row(case, name, method):
    """One line of the table."""
    start = time.perf_counter()
    mesh, note = method(case)
    seconds = time.perf_counter() - start
    mesh = mesh.trim()
    facts = topology(mesh)
    text = f"{case.name:16s} {name:10s} {len(mesh.vertices):7d} "
    text += " ".join(f"{k} {v:.3f}" for k, v in errors(mesh, case.truth).items())
    closed = bool(facts.is_closed & facts.is_manifold)
    text += (
        f" euler {int(facts.euler):4d} bodies {int(facts.num_components)}"
        f" {'closed' if closed else 'open'} loops {int(facts.boundary_loops)}"
        f" {seconds:.1f} s {note}"
    )
    print(text, flush=True)


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", nargs="+", default=list(cases.CASES))
    parser.add_argument("--data", default=os.environ["JAXGEOM_DATA"])
    parser.add_argument("--pymeshlab", action="store_true")
    parser.add_argument("--only-ours", action="store_true")
    parser.add_argument("--screening", type=float, nargs="*", default=[])
    options = parser.parse_args()
    for case in cases.load(options.data, options.cases):
        row(case, "jaxgeom", ours)
        for weight in options.screening:
            row(case, f"a={weight:g}", lambda c, w=weight: ours(c, w))
        if not options.only_ours:
            row(case, "open3d", open3d)
        if options.pymeshlab:
            row(case, "pymeshlab", pymeshlab)


if __name__ == "__main__":
    main()
