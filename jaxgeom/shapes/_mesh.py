"""Triangle meshes of static capacity."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._core import GeometryError, check_shape, message


class TriangleMesh(eqx.Module):
    """Vertices and faces, packed to the front of arrays that may be longer.

    **Arguments:**

    - `vertices`: [v, 3]; the entries from `num_vertices` on are padding.
    - `faces`: int32 [f, 3], counter-clockwise seen from outside. Unused faces, from
      `num_faces` on, name the vertex v, which does not exist.
    - `normals`: [v, 3] unit vertex normals, or None.
    - `attributes`: named arrays [v, ...] on the vertices.
    - `num_vertices`, `num_faces`: counts; the full sizes by default.

    Raises `GeometryError` for arrays whose shapes do not agree.
    """

    vertices: Float[Array, "v 3"]
    faces: Int[Array, "f 3"]
    normals: Float[Array, "v 3"] | None
    attributes: dict[str, Array]
    num_vertices: Int[Array, ""]
    num_faces: Int[Array, ""]

    def __init__(
        self,
        vertices,
        faces,
        normals=None,
        attributes=None,
        num_vertices=None,
        num_faces=None,
    ):
        check_shape("vertices", vertices, (None, 3))
        check_shape("faces", faces, (None, 3))
        v, f = vertices.shape[0], faces.shape[0]
        if not jnp.issubdtype(faces.dtype, jnp.integer):
            raise GeometryError(
                message(
                    "faces must hold integer vertex indices",
                    f"dtype {faces.dtype}",
                    "Convert with faces.astype('int32').",
                )
            )
        self.vertices = vertices
        self.faces = faces.astype(np.int32)
        self.normals = normals
        self.attributes = dict(attributes or {})
        if normals is not None:
            check_shape("normals", normals, (v, 3))
        for name, value in self.attributes.items():
            check_shape(f"attribute {name!r}", value, (v, *value.shape[1:]))
        self.num_vertices = np.int32(v) if num_vertices is None else num_vertices
        self.num_faces = np.int32(f) if num_faces is None else num_faces

    @property
    def vertex_mask(self) -> Bool[Array, " v"]:
        """True for the real vertices."""
        return jnp.arange(self.vertices.shape[0]) < self.num_vertices

    @property
    def face_mask(self) -> Bool[Array, " f"]:
        """True for the real faces."""
        return jnp.arange(self.faces.shape[0]) < self.num_faces

    def triangles(self) -> Float[Array, "f 3 3"]:
        """The corners of every face; padding faces collapse to the origin."""
        return self.vertices.at[self.faces].get(mode="fill", fill_value=0)

    def trim(self) -> "TriangleMesh":
        """The mesh of exact size (host only: the size depends on the counts)."""
        v, f = int(self.num_vertices), int(self.num_faces)
        normals = None if self.normals is None else self.normals[:v]
        attributes = {k: x[:v] for k, x in self.attributes.items()}
        return TriangleMesh(self.vertices[:v], self.faces[:f], normals, attributes)
