"""From a mesh to the values of a field on a grid."""

from jaxtyping import Array, Float

from ..neighbors import AbstractSign, Pseudonormal, signed_distance
from ..shapes import Grid, TriangleMesh

_PSEUDONORMAL = Pseudonormal()


def voxelize(
    mesh: TriangleMesh, grid: Grid, *, sign: AbstractSign = _PSEUDONORMAL
) -> Float[Array, "x y z"]:
    """The signed distance of a closed mesh at every node of a grid, negative inside.

    `voxelize(mesh, grid) < 0` is its occupancy; `fields.Sampled(grid, values)` makes it
    a field and `isosurface.extract(values, grid)` a mesh again. `sign` is
    `neighbors.Pseudonormal()`, for meshes that are oriented and welded (`repair`), or
    `Winding()`; derivatives are those of `neighbors.signed_distance`. Infinite for a
    mesh without faces.

        values = voxelize(mesh, Grid.around(PointCloud(mesh.vertices), resolution=64))
    """
    nodes = grid.nodes().reshape(-1, 3)
    return signed_distance(mesh, nodes, sign=sign).distances.reshape(grid.shape)
