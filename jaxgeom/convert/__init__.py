"""From every representation of a shape to the others: one function for each way."""

from ._clouds import cloud_to_field as cloud_to_field
from ._clouds import cloud_to_grid as cloud_to_grid
from ._clouds import cloud_to_mesh as cloud_to_mesh
from ._clouds import field_to_cloud as field_to_cloud
from ._clouds import grid_to_cloud as grid_to_cloud
from ._clouds import mesh_to_cloud as mesh_to_cloud
from ._clouds import vertices_to_cloud as vertices_to_cloud
from ._fields import field_to_grid as field_to_grid
from ._fields import field_to_mesh as field_to_mesh
from ._fields import grid_to_field as grid_to_field
from ._fields import grid_to_mesh as grid_to_mesh
from ._fields import mesh_to_field as mesh_to_field
from ._fields import mesh_to_grid as mesh_to_grid
from ._polygons import mesh_to_polygons as mesh_to_polygons
from ._polygons import polygons_to_mesh as polygons_to_mesh
from ._surfaces import surface_to_cloud as surface_to_cloud
from ._surfaces import surface_to_field as surface_to_field
from ._surfaces import surface_to_mesh as surface_to_mesh
from ._table import CONVERSIONS as CONVERSIONS
from ._table import Conversion as Conversion
from ._table import table as table
