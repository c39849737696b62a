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
    Conversion(
        "surface_to_polygons", "parametric", "polygons", False, "that mesh as quads"
    ),
    Conversion(
        "surface_to_grid",
        "parametric",
        "grid values",
        False,
        "that mesh's distance at the nodes",
    ),
    Conversion(
        "polygons_to_cloud", "polygons", "cloud", False, "points on the triangles"
    ),
    Conversion(
        "polygons_to_field", "polygons", "field", False, "the triangles' distance"
    ),
    Conversion(
        "polygons_to_grid", "polygons", "grid values", False, "that at the nodes"
    ),
    Conversion(
        "grid_to_polygons",
        "grid values",
        "polygons",
        False,
        "the zero surface, as quads",
    ),
    Conversion(
        "field_to_polygons", "field", "polygons", False, "the zero surface, as quads"
    ),
    Conversion(
        "cloud_to_polygons", "cloud", "polygons", False, "the surface of its field"
    ),
    Conversion(
        "mesh_to_surface", "mesh", "parametric", False, "a disc, smoothed to a NURBS"
    ),
    Conversion(
        "polygons_to_surface", "polygons", "parametric", False, "the same of polygons"
    ),
    Conversion(
        "grid_to_surface",
        "grid values",
        "parametric",
        False,
        "a sheet through the grid, smoothed",
    ),
    Conversion(
        "field_to_surface", "field", "parametric", False, "a sheet, smoothed to a NURBS"
    ),
    Conversion(
        "cloud_to_surface",
        "cloud",
        "parametric",
        False,
        "a sheet that is seen from one side",
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
