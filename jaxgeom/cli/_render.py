"""`jaxgeom render FILE -o PICTURE`."""

from .. import PointCloud
from ..render import Camera, render_cloud, render_mesh, save_png
from ._files import load_shape
from ._main import OK
from ._report import say


def run(arguments) -> int:
    """Draw a mesh, or the points of a file without faces."""
    size = (arguments.size, arguments.size)
    view = {"azimuth": arguments.azimuth, "elevation": arguments.elevation}
    shape = load_shape(arguments.input)
    if isinstance(shape, PointCloud):
        image = render_cloud(shape, Camera.around(shape.points, **view), size=size)
    else:
        image = render_mesh(shape, Camera.around(shape.vertices, **view), size=size)
    save_png(arguments.output, image)
    say(f"wrote {arguments.output}")
    return OK
