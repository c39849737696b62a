"""Pictures of point clouds."""

import numpy as np

from ..fields import Camera
from ..shapes import PointCloud
from ._shading import Seen, shade
from ._visibility import ZBuffer, chunks, fragments

_SLATE = (0.33, 0.47, 0.62)


def render_cloud(
    cloud: PointCloud,
    camera: Camera,
    *,
    size: tuple[int, int],
    radius: float | None = None,
    color=_SLATE,
    samples: int = 2,
) -> np.ndarray:
    """The picture uint8 [h, w, 3] of a cloud: a little ball per point (host).

    Balls are lit by the normals of the cloud where it has them, else by their own; they
    are painted with the attribute `colors` [n, 3] in [0, 1], else with `color`.

    **Arguments:** `size`: (height, width) in pixels; `radius`: of the balls, in the
    unit of the points, by default 1.5 pixels at the median depth; `samples`: rays along
    each side of a pixel, averaged.
    """
    cloud = cloud.trim()
    fine = (samples * size[0], samples * size[1])
    pixels = np.asarray(camera.pixels(np.asarray(cloud.points), fine), np.float64)
    focal = float(camera.focal(fine[0]))
    radius = _default_radius(pixels[:, 2], focal, samples) if radius is None else radius
    point = _nearest_balls(pixels, radius, focal, fine)
    hit = point < len(pixels)
    directions = np.asarray(camera.directions(fine), np.float32)
    normals, colors = np.zeros_like(directions), np.zeros_like(directions)
    colors[hit] = _paint(cloud, color)[point[hit]]
    if cloud.normals is None:
        normals[hit] = _ball_normals(point, hit, pixels, radius, focal, camera)
    else:
        normals[hit] = _unit(np.asarray(cloud.normals))[point[hit]]
    return shade(Seen(hit, normals, directions, colors), camera, samples)


def _default_radius(depth, focal, samples):
    ahead = depth[depth > 0]
    return 1.5 * samples * float(np.median(ahead)) / focal if len(ahead) else 1.0


def _nearest_balls(pixels, radius, focal, size):
    """The nearest ball [h, w] under every pixel center; their number where none."""
    ahead = np.flatnonzero(pixels[:, 2] > radius)
    center, reach = pixels[ahead, :2], radius * focal / pixels[ahead, 2:]
    last = np.array([size[1] - 1, size[0] - 1])
    low = np.ceil(np.clip(center - reach, 0, last + 1)).astype(int)
    high = np.floor(np.clip(center + reach, -1, last)).astype(int)
    counts = np.prod(np.maximum(high - low + 1, 0), axis=1)
    shown = counts > 0
    ahead, center, reach = ahead[shown], center[shown], reach[shown, 0]
    low, high = low[shown], high[shown]
    buffer = ZBuffer(size, len(pixels))
    for part in chunks(counts[shown]):
        item, column, row = fragments(low[part], high[part])
        offset = np.stack([column, row], axis=-1) - center[part][item]
        bulge = 1 - np.sum(offset**2, axis=-1) / reach[part][item] ** 2
        inside, points = bulge >= 0, ahead[part][item]
        depth = pixels[points, 2] - radius * np.sqrt(np.maximum(bulge, 0))
        flat = row * size[1] + column
        buffer.put(flat[inside], depth[inside], points[inside])
    return buffer.items()


def _ball_normals(point, hit, pixels, radius, focal, camera):
    row, column = np.nonzero(hit)
    seen = pixels[point[hit]]
    reach = radius * focal / seen[:, 2]
    x, y = (column - seen[:, 0]) / reach, (seen[:, 1] - row) / reach
    toward = np.sqrt(np.maximum(1 - x * x - y * y, 0))
    return np.stack([x, y, -toward], axis=-1) @ np.asarray(camera.axes())


def _paint(cloud, color):
    if "colors" in cloud.attributes:
        return np.asarray(cloud.attributes["colors"], np.float32)[:, :3]
    return np.broadcast_to(np.float32(color), (len(cloud.points), 3))


def _unit(v):
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(length > 0, length, 1)
