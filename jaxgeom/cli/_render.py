"""`jaxgeom render FILE -o PICTURE`."""

import itertools

import numpy as np

from .. import PointCloud
from ..render import Camera, render_cloud, render_field, render_mesh, save_png
from ._files import load_shape
from ._main import OK
from ._report import say
from ._scene import box_of, is_scene, load_scene


def run(arguments) -> int:
    """Draw a mesh, the points of a file without faces, or a field of a script."""
    size = (arguments.size, arguments.size)
    view = {"azimuth": arguments.azimuth, "elevation": arguments.elevation}
    if is_scene(arguments.input):
        image = _field(arguments, size, view)
    else:
        image = _shape(load_shape(arguments.input), size, view)
    save_png(arguments.output, image)
    say(f"wrote {arguments.output}")
    return OK


def _field(arguments, size, view):
    field = load_scene(arguments.input)
    low, high = box_of(field, arguments.bounds, arguments.input)
    corners = list(itertools.product(*zip(low, high, strict=True)))
    camera = Camera.around(np.asarray(corners, np.float32), **view)
    return render_field(field, camera, size=size)


def _shape(shape, size, view):
    if isinstance(shape, PointCloud):
        return render_cloud(shape, Camera.around(shape.points, **view), size=size)
    return render_mesh(shape, Camera.around(shape.vertices, **view), size=size)
