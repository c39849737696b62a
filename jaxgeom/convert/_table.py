"""What every conversion keeps."""

from typing import NamedTuple


class Conversion(NamedTuple):
    """One way from one representation to another."""

    function: str
    source: str
    target: str
    exact: bool
    keeps: str


CONVERSIONS = (
    Conversion(
        "vertices_to_cloud", "mesh", "cloud", True, "the vertices; the faces are lost"
    ),
    Conversion(
        "mesh_to_cloud",
        "mesh",
        "cloud",
        False,
        "points on the surface, not its shape between",
    ),
    Conversion(
        "mesh_to_field", "mesh", "field", True, "the signed distance everywhere"
    ),
    Conversion(
        "mesh_to_grid", "mesh", "grid values", False, "the signed distance at the nodes"
    ),
    Conversion(
        "mesh_to_polygons", "mesh", "polygons", True, "everything but vertex normals"
    ),
    Conversion(
        "polygons_to_mesh", "polygons", "mesh", False, "faces that are plane and convex"
    ),
    Conversion(
        "field_to_grid", "field", "grid values", False, "the values at the nodes"
    ),
    Conversion(
        "grid_to_field", "grid values", "field", True, "the values at the nodes"
    ),
    Conversion(
        "field_to_mesh", "field", "mesh", False, "the zero surface, to order spacing^2"
    ),
    Conversion(
        "grid_to_mesh",
        "grid values",
        "mesh",
        False,
        "the zeros on the edges of the grid",
    ),
    Conversion(
        "field_to_cloud", "field", "cloud", False, "points and normals of the surface"
    ),
    Conversion(
        "grid_to_cloud", "grid values", "cloud", False, "points of the extracted mesh"
    ),
    Conversion(
        "cloud_to_field", "cloud", "field", False, "a smooth surface near the points"
    ),
    Conversion(
        "cloud_to_grid", "cloud", "grid values", False, "that field at the nodes"
    ),
    Conversion(
        "cloud_to_mesh", "cloud", "mesh", False, "the zero surface of that field"
    ),
    Conversion(
        "surface_to_mesh", "parametric", "mesh", False, "the surface, to order cell^2"
    ),
    Conversion(
        "surface_to_cloud", "parametric", "cloud", False, "points of it, and normals"
    ),
    Conversion(
        "surface_to_field", "parametric", "field", False, "that mesh's signed distance"
    ),
)


def table() -> str:
    """The conversions as a table in Markdown."""
    head = "| function | from | to | exact | what is kept |\n|---|---|---|---|---|\n"
    line = lambda c: (
        f"| `{c.function}` | {c.source} | {c.target} | "
        f"{'yes' if c.exact else 'no'} | {c.keeps} |\n"
    )
    return head + "".join(line(c) for c in CONVERSIONS)
