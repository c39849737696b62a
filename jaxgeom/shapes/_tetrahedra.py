"""Solids made of tetrahedra."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._core import GeometryError, check_shape, message
from ._mesh import TriangleMesh

# Counter-clockwise seen from outside where the volume is positive.
_SIDES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


class TetrahedralMesh(eqx.Module):
    """Vertices, and tetrahedra of four of them; no padding.

    - `vertices`: [v, 3].
    - `tetrahedra`: integers [t, 4]. Seen from its last corner the first three run
      clockwise where its volume is positive.

    Raises `GeometryError` for arrays of other shapes, and for indices outside of
    0 ... v - 1 (checked where they are known, that is not inside jit).
    """

    vertices: Float[Array, "v 3"]
    tetrahedra: Int[Array, "t 4"]

    def __check_init__(self):
        check_shape("vertices", self.vertices, (None, 3))
        check_shape("tetrahedra", self.tetrahedra, (None, 4))
        if not isinstance(self.tetrahedra, np.ndarray) or not self.tetrahedra.size:
            return
        low, high = self.tetrahedra.min(), self.tetrahedra.max()
        if low < 0 or high >= self.vertices.shape[0]:
            raise GeometryError(
                message(
                    f"tetrahedra must name vertices 0 to {len(self.vertices) - 1}",
                    f"indices from {low} to {high}",
                    "Count from zero, and keep every vertex.",
                )
            )

    def volumes(self) -> Float[Array, " t"]:
        """The signed volume of every tetrahedron, negative where it is turned over."""
        a, b, c, d = jnp.moveaxis(jnp.asarray(self.vertices)[self.tetrahedra], 1, 0)
        return jnp.sum(jnp.cross(b - a, c - a) * (d - a), axis=-1) / 6

    def boundary(self) -> TriangleMesh:
        """The sides that belong to one tetrahedron, as a mesh of the same vertices
        (host)."""
        sides = np.asarray(self.tetrahedra)[:, _SIDES].reshape(-1, 3)
        _, kind, count = np.unique(
            np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
        )
        faces = sides[count[kind.reshape(-1)] == 1]
        return TriangleMesh(self.vertices, faces.astype(np.int32))
