"""Are signed distances right, also nearest to edges and vertices? (CPU)

    python experiments/neighbors/signed_accuracy.py DATA/meshes/nefertiti.ply

100 000 queries: in the bounding cube, and from 1e-5 to 1e-1 of the size off the
vertices, the edges and the faces, along the mean normal of the faces around and in
random directions. Distances against libigl in double precision and Open3D in single;
signs against libigl's winding number in double precision (exact for a closed mesh, also
where surfaces cross), outside a band of 1e-6 of the size.
"""

import argparse

import igl
import jax
import jax.numpy as jnp
import numpy as np
import open3d as o3d
import trimesh

from jaxgeom import io
from jaxgeom.neighbors import Exact, Winding, inside, signed_distance
from jaxgeom.shapes import TriangleMesh

NUM = 100_000


def queries(v, f, rng):
    """Points of the cube, and off vertices, edges and faces, by kind."""
    mesh = trimesh.Trimesh(v, f, process=False)
    half = mesh.extents.max() / 2
    cube = mesh.bounds.mean(axis=0) + half * rng.uniform(-1.2, 1.2, (NUM // 4, 3))
    edges, faces = mesh.edges_unique, mesh.faces
    base = {
        "vertex": (v, mesh.vertex_normals),
        "edge": (v[edges].mean(axis=1), mesh.vertex_normals[edges].sum(axis=1)),
        "face": (v[faces].mean(axis=1), mesh.face_normals),
    }
    out, kinds = [cube], ["cube"] * len(cube)
    for kind, (points, normals) in base.items():
        pick = rng.integers(0, len(points), NUM // 4)
        way = normals[pick] / np.linalg.norm(normals[pick], axis=1, keepdims=True)
        random = rng.normal(size=way.shape)
        random /= np.linalg.norm(random, axis=1, keepdims=True)
        way = np.where(rng.uniform(size=(len(way), 1)) < 0.5, way, random)
        reach = half * 10 ** rng.uniform(-5, -1, (len(way), 1))
        out.append(points[pick] + rng.choice([-1, 1], (len(way), 1)) * reach * way)
        kinds += [kind] * len(way)
    return np.concatenate(out).astype(np.float32), np.array(kinds), half


def run(path):
    """The table of one mesh."""
    mesh = io.load_mesh(path)
    v, f = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)
    peer = trimesh.Trimesh(v, f, process=False)
    print(path, len(f), "faces; watertight", peer.is_watertight)
    points, kinds, half = queries(v.astype(float), f, np.random.default_rng(0))
    v64, f64, q64 = v.astype(float), f.astype(np.int64), points.astype(float)
    far = np.sqrt(igl.point_mesh_squared_distance(q64, v64, f64)[0])
    inner = np.abs(igl.winding_number(v64, f64, q64)) > 0.5
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(v, f.astype(np.uint32))
    theirs = scene.compute_signed_distance(points).numpy()
    pseudo = igl.signed_distance(q64, v64, f64, sign_type=1)[0]
    single = TriangleMesh(jnp.asarray(v), jnp.asarray(f))
    found = {
        "jaxgeom, pseudonormal": jax.jit(signed_distance)(single, points).distances,
        "jaxgeom, winding": jax.jit(lambda m, q: signed_distance(m, q, sign=Winding()))(
            single, points
        ).distances,
        "Open3D, rays": theirs,
        "igl float64, pseudonormal": pseudo,
    }
    clear = far > 1e-6 * half
    for name, distances in found.items():
        distances = np.asarray(distances)
        error = np.abs(np.abs(distances) - far).max() / half
        wrong = clear & ((distances < 0) != inner)
        counts = {k: int(wrong[kinds == k].sum()) for k in sorted(set(kinds.tolist()))}
        deepest = far[wrong].max(initial=0) / half
        print(
            f"{name:27s} error {error:.1e}  wrong signs {counts}, up to {deepest:.1e}"
        )
    disputed = clear & ((np.asarray(found["jaxgeom, pseudonormal"]) < 0) != inner)
    print("    of ours, igl's pseudonormal agrees with us in", end=" ")
    print(int(((pseudo < 0) != inner)[disputed].sum()), "of", int(disputed.sum()))
    sure = inside(single, points[:2000], method=Exact()) == inner[:2000]
    print(
        "    exact winding in single precision: wrong", int((~np.asarray(sure)).sum())
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("meshes", nargs="+")
    for each in parser.parse_args().meshes:
        run(each)
