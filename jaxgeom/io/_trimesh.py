"""To and from trimesh, which is imported only when one of these is called."""

import io

import numpy as np

from .._core import GeometryError, message
from ..shapes import PointCloud, TriangleMesh
from ._columns import (
    COLOR,
    NORMAL,
    POSITION,
    Contents,
    block,
    byte_colors,
    of_mesh,
    unit_colors,
)
from ._errors import cut_short, damaged


def to_trimesh(shape: TriangleMesh | PointCloud):
    """The `trimesh.Trimesh` of a mesh, or the `trimesh.PointCloud` of a cloud.

    Padding is left out, nothing is merged. Colors become vertex colors; a trimesh cloud
    has no place for normals. Raises `GeometryError` for a batch.
    """
    import trimesh

    if isinstance(shape, PointCloud):
        cloud = shape.trim()
        colors = cloud.attributes.get("colors")
        colors = None if colors is None else byte_colors(np.asarray(colors))
        return trimesh.PointCloud(np.asarray(cloud.points), colors=colors)
    out = _geometry(of_mesh(shape))
    mesh = shape.trim()
    for name, value in mesh.attributes.items():
        if name != "colors":
            out.vertex_attributes[name] = np.asarray(value)
    return out


def from_trimesh(geometry) -> TriangleMesh | PointCloud:
    """The mesh of a `trimesh.Trimesh` or `Scene`, the cloud of a `trimesh.PointCloud`.

    Positions keep their precision; nothing is merged. Normals are taken where the
    trimesh object holds them already. The meshes of a scene are placed and joined, with
    what all of them carry. Raises `GeometryError` for other objects, or a scene without
    a mesh.
    """
    import trimesh

    if isinstance(geometry, trimesh.Scene):
        return _scene_mesh(geometry)
    if isinstance(geometry, trimesh.PointCloud):
        colors = np.asarray(geometry.colors)
        attributes = {"colors": unit_colors(colors[:, :3])} if colors.size else {}
        return PointCloud(np.array(geometry.vertices), None, None, attributes)
    if not isinstance(geometry, trimesh.Trimesh):
        raise GeometryError(
            message(
                "from_trimesh needs a trimesh.Trimesh, Scene or PointCloud",
                f"a {type(geometry).__name__}",
                "Load it with trimesh.load_mesh.",
            )
        )
    attributes = {k: np.array(v) for k, v in geometry.vertex_attributes.items()}
    count = len(geometry.vertices)
    attributes = {k: v for k, v in attributes.items() if v.ndim and len(v) == count}
    if geometry.visual.kind == "vertex":
        colors = np.array(geometry.visual.vertex_colors)
        attributes["colors"] = unit_colors(colors[:, :3])
    # Asking for the normals computes them: the cache tells whether they were given.
    known = "vertex_normals" in geometry._cache
    normals = np.array(geometry.vertex_normals) if known else None
    faces = np.array(geometry.faces, np.int32)
    return TriangleMesh(np.array(geometry.vertices), faces, normals, attributes)


def _scene_mesh(scene):
    """One mesh of a scene; `trimesh.Scene.to_mesh` would lose the normals."""
    import trimesh

    nodes = [scene.graph[node] for node in scene.graph.nodes_geometry]
    placed = [(placement, scene.geometry[key]) for placement, key in nodes]
    parts = [
        _placed(from_trimesh(shape), np.asarray(placement))
        for placement, shape in placed
        if isinstance(shape, trimesh.Trimesh)
    ]
    if not parts:
        raise GeometryError(
            message(
                "a scene must hold at least one mesh",
                f"{len(placed)} other objects",
                "Export the mesh itself.",
            )
        )
    counts = np.array([len(part.vertices) for part in parts])
    starts = np.cumsum(counts) - counts
    join = lambda arrays: np.concatenate(list(arrays))
    oriented = all(part.normals is not None for part in parts)
    shared = set.intersection(*(set(part.attributes) for part in parts))
    return TriangleMesh(
        join(part.vertices for part in parts),
        join(p.faces + start for p, start in zip(parts, starts, strict=True)),
        join(part.normals for part in parts) if oriented else None,
        {k: join(part.attributes[k] for part in parts) for k in sorted(shared)},
    )


def _placed(mesh, placement):
    linear, offset = placement[:3, :3], placement[:3, 3]
    vertices, faces, normals = mesh.vertices @ linear.T + offset, mesh.faces, None
    mirrored = np.linalg.det(linear) < 0
    if mesh.normals is not None:
        # Normals turn with the inverse transpose, which does not keep their length.
        turned = mesh.normals @ np.linalg.inv(linear)
        length = np.linalg.norm(turned, axis=1, keepdims=True)
        zero = np.zeros_like(turned)
        normals = np.divide(turned, length, out=zero, where=length > 0)
    faces = faces[:, ::-1] if mirrored else faces
    return TriangleMesh(vertices, faces, normals, mesh.attributes)


def read_glb(data: bytes, name: str) -> Contents:
    """The meshes of a binary glTF file as one, through trimesh."""
    import trimesh

    length = int.from_bytes(data[8:12], "little")
    if len(data) < length or len(data) < 12:
        raise cut_short(name, "GLB", "bytes", max(length, 12), len(data))
    # trimesh has no common error: whatever it raises means that it cannot read this.
    try:
        loaded = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False)
        mesh = from_trimesh(loaded)
    except Exception as error:
        raise damaged(name, "GLB", str(error) or type(error).__name__) from error
    columns = dict(zip(POSITION, _single(mesh.vertices).T, strict=True))
    if mesh.normals is not None:
        columns |= zip(NORMAL, _single(mesh.normals).T, strict=True)
    if "colors" in mesh.attributes:
        columns |= zip(COLOR, mesh.attributes["colors"].T, strict=True)
    return Contents(columns, np.asarray(mesh.faces))


def write_glb(contents: Contents) -> bytes:
    """A binary glTF file of positions, normals, colors and faces, through trimesh."""
    return _geometry(contents).export(file_type="glb")


def _geometry(contents):
    import trimesh

    columns = contents.columns
    return trimesh.Trimesh(
        block(columns, POSITION),
        contents.faces,
        vertex_normals=block(columns, NORMAL),
        vertex_colors=block(columns, COLOR),
        process=False,
    )


def _single(x):
    """float32, where a scene's placements have left every value one."""
    single = x.astype(np.float32)
    return single if np.array_equal(single, x, equal_nan=True) else x
