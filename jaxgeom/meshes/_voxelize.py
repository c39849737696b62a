"""From a mesh to the values of a field on a grid."""

from jaxtyping import Array, Float

from ..neighbors import signed_distance
from ..shapes import Grid, TriangleMesh


def voxelize(mesh: TriangleMesh, grid: Grid) -> Float[Array, "x y z"]:
    """The signed distance of a closed mesh at every node of a grid, negative inside.

    `voxelize(mesh, grid) < 0` is its occupancy; `fields.Sampled(grid, values)` makes it
    a field and `isosurface.extract(values, grid)` a mesh again. The mesh must be
    oriented and welded (`repair`); sign and derivatives are those of
    `neighbors.signed_distance`. Infinite for a mesh without faces.

        values = voxelize(mesh, Grid.around(PointCloud(mesh.vertices), resolution=64))
    """
    nodes = grid.nodes().reshape(-1, 3)
    return signed_distance(mesh, nodes).distances.reshape(grid.shape)
