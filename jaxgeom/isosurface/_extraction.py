"""What every extractor takes and returns."""

import math

import equinox as eqx
from jaxtyping import Array, Int

from .._core import RESULTS, GeometryError, bucket, message
from ..shapes import TriangleMesh


class Capacity(eqx.Module):
    """Static sizes of an extraction: vertices, faces, and cells that hold surface.

    Each is at least 1. Without `cells` that of the faces is taken: every such cell
    has a face.
    """

    vertices: int = eqx.field(static=True)
    faces: int = eqx.field(static=True)
    cells: int = eqx.field(static=True)

    def __init__(self, vertices: int, faces: int, cells: int | None = None):
        self.vertices = vertices
        self.faces = faces
        self.cells = faces if cells is None else cells
        if min(self.vertices, self.faces, self.cells) < 1:
            raise GeometryError(
                message(
                    "capacities must be at least 1",
                    f"{(self.vertices, self.faces, self.cells)}",
                    "Measure them with `count`, or call `extract`.",
                )
            )

    @staticmethod
    def holding(vertices: int, faces: int, cells: int) -> "Capacity":
        """The capacity for at least these counts, rounded up to shared buckets.

        A closed surface has about as many cells as vertices and twice as many faces:
        one bucket for the three gives far fewer programs than three.
        """
        size = bucket(max(vertices, -(-faces // 2), cells))
        return Capacity(size, 2 * size, size)

    @staticmethod
    def for_surface(shape: tuple[int, int, int], *, areas: float = 4.0) -> "Capacity":
        """The capacity for a smooth surface of a known area, without measuring.

        `areas` counts the largest section of the grid: a sphere that touches all six
        sides has pi of them. A unit of area with normal n cuts |n|_1 <= sqrt(3) edges;
        a closed surface has about as many cells as vertices, and twice as many faces.
        """
        x, y, z = shape
        section = max(x * y, y * z, x * z)
        vertices = math.ceil(math.sqrt(3) * areas * section)
        return Capacity.holding(vertices, 2 * vertices, vertices)


class Extraction(eqx.Module):
    """A mesh of static capacity, with the sizes that it would have needed.

    On overflow `result` is `capacity_exceeded` and the mesh a valid prefix: its faces
    name existing vertices. Other statuses: `nonfinite_input` (such samples count as
    outside), `no_surface`. The required sizes are exact in any case, but for the faces
    with a decider (at most as many).
    """

    mesh: TriangleMesh
    result: RESULTS
    required_vertices: Int[Array, ""]
    required_faces: Int[Array, ""]
    required_cells: Int[Array, ""]
