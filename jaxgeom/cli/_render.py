"""`jaxgeom render FILE -o PICTURE`."""

from ..io import FileError, load_cloud, load_mesh
from ..render import Camera, render_cloud, render_mesh, save_png
from ._main import OK
from ._report import say


def run(arguments) -> int:
    """Draw a mesh, or the points of a file without faces."""
    size = (arguments.size, arguments.size)
    view = {"azimuth": arguments.azimuth, "elevation": arguments.elevation}
    try:
        mesh = load_mesh(arguments.input)
    except FileError:
        cloud = load_cloud(arguments.input)
        image = render_cloud(cloud, Camera.around(cloud.points, **view), size=size)
    else:
        image = render_mesh(mesh, Camera.around(mesh.vertices, **view), size=size)
    save_png(arguments.output, image)
    say(f"wrote {arguments.output}")
    return OK
