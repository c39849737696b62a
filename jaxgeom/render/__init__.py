"""Pictures without a display or a graphics card, and pages for the browser."""

from ..fields import Camera as Camera
from ._cloud import render_cloud as render_cloud
from ._field import render_field as render_field
from ._files import save_html as save_html
from ._files import save_png as save_png
from ._files import side_by_side as side_by_side
from ._lighting import AmbientOcclusion as AmbientOcclusion
from ._lighting import SoftShadows as SoftShadows
from ._mesh import render_mesh as render_mesh
