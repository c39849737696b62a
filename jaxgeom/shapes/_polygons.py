"""Meshes whose faces have any number of corners."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core import GeometryError, check_shape, message
from ._mesh import TriangleMesh


class PolygonMesh(eqx.Module):
    """Vertices, and faces grouped by their number of corners.

    **Arguments:**

    - `vertices`: [v, 3].
    - `faces`: one integer array [f, k], or a tuple of them, one for each number of
      corners k >= 3; the corners run counter-clockwise seen from outside. There is no
      padding: every index names a vertex.
    - `attributes`: named arrays [v, ...] on the vertices.

    Raises `GeometryError` for arrays whose shapes do not agree, for two arrays of the
    same k and for indices outside of 0 ... v - 1 (these are checked where the faces are
    known, that is not inside jit).

    >>> square = PolygonMesh(np.eye(4, 3), np.array([[0, 1, 2, 3]]))
    >>> square.triangulate().faces.tolist()
    [[0, 1, 2], [0, 2, 3]]
    """

    vertices: Float[Array, "v 3"]
    faces: tuple[Int[Array, "f k"], ...]
    attributes: dict[str, Array]

    def __init__(self, vertices, faces, attributes=None):
        check_shape("vertices", vertices, (None, 3))
        groups = faces if isinstance(faces, tuple | list) else (faces,)
        v = vertices.shape[0]
        self.vertices = vertices
        self.faces = tuple(_checked(group, v) for group in groups)
        self.attributes = dict(attributes or {})
        _check_distinct([group.shape[1] for group in self.faces])
        for name, value in self.attributes.items():
            check_shape(f"attribute {name!r}", value, (v, *value.shape[1:]))

    @property
    def num_faces(self) -> int:
        """The number of faces of all kinds together."""
        return sum(group.shape[0] for group in self.faces)

    @classmethod
    def from_triangles(cls, mesh: TriangleMesh) -> "PolygonMesh":
        """The same mesh with one array of triangles (host: the padding is cut off)."""
        mesh = mesh.trim()
        return cls(mesh.vertices, (mesh.faces,), mesh.attributes)

    def triangulate(self) -> TriangleMesh:
        """Every face of k corners as the k - 2 triangles (first, i, i + 1).

        The triangles of one face follow each other, groups in their order. Exact for
        plane convex faces; any other face is replaced by this fan.
        """
        fans = [_fan(jnp.asarray(group)) for group in self.faces]
        faces = jnp.concatenate(fans) if fans else jnp.zeros((0, 3), jnp.int32)
        return TriangleMesh(self.vertices, faces, attributes=self.attributes)


def _fan(group: Int[Array, "f k"]) -> Int[Array, "t 3"]:
    k = group.shape[1]
    picks = np.stack([np.zeros(k - 2, int), np.arange(1, k - 1), np.arange(2, k)], -1)
    return group[:, picks].reshape(-1, 3)


def _checked(group, v: int):
    """The group as int32, with its corners and indices checked."""
    if not hasattr(group, "dtype"):
        group = np.asarray(group)
    check_shape("each array of faces", group, (None, None))
    if group.shape[1] < 3 or not jnp.issubdtype(group.dtype, jnp.integer):
        must = "faces must be integer arrays [f, k] with k >= 3 corners"
        given = f"shape {tuple(group.shape)} of dtype {group.dtype}"
        raise GeometryError(message(must, given, "Pass one array for each k."))
    if not isinstance(group, jax.core.Tracer) and group.size:
        low, high = int(np.min(group)), int(np.max(group))
        if low < 0 or high >= v:
            must = f"faces must name vertices 0 ... {v - 1}"
            given = f"indices from {low} to {high}"
            fix = "Remove the faces that name other vertices, or pass all vertices."
            raise GeometryError(message(must, given, fix))
    return group.astype(np.int32)


def _check_distinct(sizes):
    if len(set(sizes)) < len(sizes):
        must = "there must be one array of faces for each number of corners"
        fix = "Concatenate the arrays of the same k."
        raise GeometryError(message(must, f"arrays with k = {sizes}", fix))
