"""Refined positions against five other libraries, in double precision.

    JAXGEOM_DATA=... python experiments/subdivision/peers.py

Needs igl, open3d, trimesh, gpytoolbox, vtk and compas. Prints the largest distance from
a vertex of one result to the nearest of the other, both ways, after two levels.
"""

import os
import pathlib

import gpytoolbox
import igl
import jax
import numpy as np
import open3d
import trimesh
import vtk
from compas.datastructures import Mesh
from scipy.spatial import ConvexHull, cKDTree
from vtk.util import numpy_support

from jaxgeom import PolygonMesh, TriangleMesh, io
from jaxgeom.meshes import icosphere
from jaxgeom.subdivision import CatmullClark, Creases, Loop, Warren, plan_subdivision

LEVELS = 2


def by_igl(v, f):
    return igl.loop(v, f.astype(np.int64), LEVELS)[0]


def by_open3d(v, f):
    mesh = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(np.array(v)),
        open3d.utility.Vector3iVector(np.array(f)),
    )
    return np.asarray(mesh.subdivide_loop(LEVELS).vertices)


def by_trimesh(v, f):
    return trimesh.remesh.subdivide_loop(v, f, LEVELS)[0]


def by_gpytoolbox(v, f):
    return gpytoolbox.subdivide(v, f, method="loop", iters=LEVELS)[0]


def by_vtk(v, f):
    points, cells, mesh = vtk.vtkPoints(), vtk.vtkCellArray(), vtk.vtkPolyData()
    points.SetDataTypeToDouble()
    points.SetData(numpy_support.numpy_to_vtk(np.ascontiguousarray(v), deep=True))
    for face in f.tolist():
        cells.InsertNextCell(3, face)
    mesh.SetPoints(points)
    mesh.SetPolys(cells)
    tool = vtk.vtkLoopSubdivisionFilter()
    tool.SetInputData(mesh)
    tool.SetNumberOfSubdivisions(LEVELS)
    tool.Update()
    return numpy_support.vtk_to_numpy(tool.GetOutput().GetPoints().GetData())


def by_compas(mesh, creases):
    faces = [row for group in mesh.faces for row in np.asarray(group).tolist()]
    other = Mesh.from_vertices_and_faces(np.asarray(mesh.vertices).tolist(), faces)
    other.update_default_edge_attributes({"crease": 0})
    for (a, b), s in zip(creases.edges.tolist(), creases.sharpness, strict=True):
        other.edge_attribute((a, b), "crease", int(min(s, 9)))
    for edge in other.edges():
        if other.is_edge_on_boundary(edge):
            other.edge_attribute(edge, "crease", 9)
    fine = other.subdivided(scheme="catmullclark", k=LEVELS)
    return np.array([fine.vertex_coordinates(key) for key in fine.vertices()])


def gap(a, b):
    if len(a) != len(b):
        return f"{len(a)} against {len(b)} vertices"
    return f"{max(cKDTree(a).query(b)[0].max(), cKDTree(b).query(a)[0].max()):.1e}"


def ours(mesh, scheme, creases=None):
    plan = plan_subdivision(mesh, LEVELS, scheme=scheme, creases=creases)
    return np.asarray(plan.operator @ np.asarray(mesh.vertices, float))


def triangle_meshes():
    points = np.random.default_rng(1).normal(size=(200, 3))
    hull = trimesh.Trimesh(points, ConvexHull(points).simplices)
    hull.fix_normals()
    v, f = np.array(hull.vertices), np.array(hull.faces, np.int32)
    yield "icosphere", TriangleMesh(*map(np.asarray, _sphere()))
    yield (
        f"hull, valence {np.bincount(f.ravel()).min()}-{np.bincount(f.ravel()).max()}",
        (TriangleMesh(v, f)),
    )
    hole = _without(icosphere(2), 0)
    yield "sphere with a hole", hole
    strip = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]], np.int32)
    yield "strip: inner edges join the border", TriangleMesh(v[:6], strip)
    path = pathlib.Path(os.environ["JAXGEOM_DATA"]) / "meshes" / "fertility.ply"
    real = io.load_mesh(path)
    yield "fertility", TriangleMesh(np.asarray(real.vertices), np.asarray(real.faces))


def _sphere():
    mesh = icosphere(2)
    return np.asarray(mesh.vertices, float), np.asarray(mesh.faces)


def _without(mesh, vertex):
    v, f = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
    f = f[~np.any(f == vertex, axis=1)]
    return TriangleMesh(np.delete(v, vertex, axis=0), np.where(f > vertex, f - 1, f))


def polygon_meshes():
    angle = 2 * np.pi * np.arange(5) / 5
    ring = np.stack([np.cos(angle), 1.3 * np.sin(angle), 0 * angle], -1)
    vertices = np.concatenate([ring, ring + [0.1, 0, 1.2], [[0.1, 0.2, 2.1]]])
    i, j = np.arange(5), (np.arange(5) + 1) % 5
    squares = np.stack([i, j, j + 5, i + 5], -1)
    roof = np.stack([i + 5, j + 5, np.full(5, 10)], -1)
    house = PolygonMesh(vertices, (i[None, ::-1], squares, roof))
    rim = np.stack([i + 5, j + 5], -1)
    yield "pentagonal house", house, Creases()
    yield "the same, crease 1", house, Creases(rim, 1.0)
    yield "the same, crease 2, 1, ...", house, Creases(rim, [2, 1, 2, 1, 3.0])
    yield "the same, infinite crease", house, Creases(rim)
    yield "the same, corners", house, Creases(np.concatenate([rim, [(0, 5), (1, 6)]]))
    yield "open house", PolygonMesh(vertices, (squares, roof)), Creases()
    triangles = PolygonMesh.from_triangles(TriangleMesh(*_sphere()))
    yield "icosphere", triangles, Creases()


def main():
    jax.config.update("jax_enable_x64", True)
    peers = [by_igl, by_open3d, by_trimesh, by_gpytoolbox, by_vtk]
    for name, mesh in triangle_meshes():
        v, f = np.asarray(mesh.vertices, float), np.asarray(mesh.faces)
        for peer in peers:
            other = peer(v, f)
            both = [gap(ours(mesh, s), other) for s in (Loop(), Loop(Warren()))]
            label = f"{name:36s} {peer.__name__[3:]:12s}"
            print(f"{label} Loop {both[0]:24s} Warren {both[1]}")
    for name, mesh, creases in polygon_meshes():
        other = by_compas(mesh, creases)
        print(
            f"{name:36s} compas       {gap(ours(mesh, CatmullClark(), creases), other)}"
        )


if __name__ == "__main__":
    main()
