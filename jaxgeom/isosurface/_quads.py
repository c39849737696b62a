"""The quads that the dual methods split in two."""

import numpy as np

from .._core import GeometryError, message
from ..shapes import PolygonMesh, TriangleMesh


def quads(mesh: TriangleMesh) -> PolygonMesh:
    """A mesh of `dual_marching_cubes` or `dual_contouring` as quads (host).

    Their faces 2 i and 2 i + 1 are the halves of one quad around a cut edge of the
    grid. Vertices and attributes stay; vertex normals, which polygons do not carry, are
    lost. Raises `GeometryError` for faces that are no such halves, such as those of
    marching cubes, or after faces were removed.
    """
    mesh = mesh.trim()
    faces = np.asarray(mesh.faces)
    first, second = faces[::2], faces[1::2]
    halves = len(first) == len(second)
    if halves:
        # Cut from corner 0 to 2, or from 1 to 3.
        plain = (first[:, 0] == second[:, 0]) & (first[:, 2] == second[:, 1])
        turned = (first[:, 1] == second[:, 0]) & (first[:, 2] == second[:, 2])
        halves = (plain | turned).all()
    if not halves:
        raise GeometryError(
            message(
                "faces 2 i and 2 i + 1 must be the halves of a quad",
                f"{len(faces)} faces, some of them not",
                "Extract with DualMarchingCubes() or DualContouring().",
            )
        )
    corners = np.stack([first[:, 0], first[:, 1], second[:, 1], second[:, 2]], axis=1)
    return PolygonMesh(mesh.vertices, corners, mesh.attributes)
