"""Pictures of meshes."""

import numpy as np

from ..fields import Camera
from ..shapes import TriangleMesh
from ._shading import CLAY, Seen, shade
from ._visibility import visible_faces


def render_mesh(
    mesh: TriangleMesh,
    camera: Camera,
    *,
    size: tuple[int, int],
    color=CLAY,
    samples: int = 2,
) -> np.ndarray:
    """The picture uint8 [h, w, 3] of a mesh, smoothly shaded (host).

    Shows the vertex normals (weighted by angle where the mesh has none) and the
    attribute `colors` [v, 3] in [0, 1] where the mesh has it, else `color`. By embree's
    rays where `embreex` is installed, else by a z-buffer, which leaves out faces that
    reach behind the eye. Both sides of a face are shown.

    **Arguments:** `size`: (height, width) in pixels; `samples`: rays along each side
    of a pixel, averaged.
    """
    mesh = mesh.trim()
    fine = (samples * size[0], samples * size[1])
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    directions = np.asarray(camera.directions(fine), np.float32)
    face = visible_faces(vertices, faces, camera, fine)
    hit = face < len(faces)
    corners = faces[face[hit]]
    eye = np.asarray(camera.position)
    weights = _barycentric((vertices - eye)[corners], directions[hit])
    normals = np.zeros_like(directions)
    normals[hit] = _unit(_mix(_vertex_normals(mesh), corners, weights))
    colors = np.broadcast_to(np.float32(color), directions.shape).copy()
    if "colors" in mesh.attributes:
        painted = np.asarray(mesh.attributes["colors"], np.float32)[:, :3]
        colors[hit] = _mix(painted, corners, weights)
    return shade(Seen(hit, normals, directions, colors), camera, samples)


def _barycentric(triangles, directions):
    """The weights [m, 3] of where the rays from the origin meet the triangles."""
    a, b, c = np.moveaxis(np.float64(triangles), 1, 0)
    volume = lambda p, q: np.sum(np.cross(p, q) * directions, axis=-1)
    weights = np.stack([volume(b, c), volume(c, a), volume(a, b)], axis=-1)
    total = weights.sum(axis=-1, keepdims=True)
    # A face seen exactly from the side has no area to share.
    weights = np.where(total == 0, 1 / 3, weights / np.where(total == 0, 1, total))
    return np.clip(weights, 0, 1)


def _mix(values, corners, weights):
    return np.einsum("mk,mkd->md", weights, values[corners])


def _vertex_normals(mesh):
    if mesh.normals is not None:
        return np.asarray(mesh.normals)
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    ahead = _unit(np.roll(corners, -1, axis=1) - corners)
    behind = _unit(np.roll(corners, 1, axis=1) - corners)
    angles = np.arccos(np.clip(np.sum(ahead * behind, axis=-1), -1, 1))
    edges = corners[:, 1:] - corners[:, :1]
    normals = _unit(np.cross(edges[:, 0], edges[:, 1]))
    flat, length = np.asarray(mesh.faces).reshape(-1), len(mesh.vertices)
    shares = (angles[..., None] * normals[:, None]).reshape(-1, 3)
    total = [
        np.bincount(flat, weights=shares[:, d], minlength=length) for d in range(3)
    ]
    return _unit(np.stack(total, axis=-1))


def _unit(v):
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(length > 0, length, 1)
