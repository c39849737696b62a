"""Which triangle each pixel sees: by embree where it is installed, else by numpy.

Both return int [h, w], with the number of faces where nothing is seen.
"""

import numpy as np

from ..fields import Camera

_CHUNK = 1 << 22


def visible_faces(vertices, faces, camera: Camera, size) -> np.ndarray:
    """The nearest face [h, w] under the center of every pixel."""
    try:
        import embreex  # its absence is the only thing to find out here
    except ImportError:
        return by_raster(vertices, faces, camera, size)
    del embreex
    return by_rays(vertices, faces, camera, size)


def by_rays(vertices, faces, camera: Camera, size) -> np.ndarray:
    """The nearest face along the ray of every pixel (needs `embreex`)."""
    from embreex.mesh_construction import TriangleMesh as Triangles
    from embreex.rtcore_scene import EmbreeScene

    directions = np.asarray(camera.directions(size), np.float32).reshape(-1, 3)
    # Embree computes in single precision: put the eye at its origin.
    eye = np.asarray(camera.position, np.float64)
    triangles = (np.asarray(vertices, np.float64) - eye)[faces].astype(np.float32)
    scene = EmbreeScene()
    Triangles(scene, triangles)
    found = scene.run(np.zeros_like(directions), directions)
    return np.where(found < 0, len(faces), found).reshape(size)


def by_raster(vertices, faces, camera: Camera, size) -> np.ndarray:
    """The nearest face under every pixel center, by a z-buffer.

    A face that reaches behind the eye is not drawn.
    """
    pixels = _pixels(vertices, camera, size)
    drawn = np.flatnonzero((pixels[faces][..., 2] > 0).all(axis=1))
    corners = pixels[faces[drawn]]
    low, high = _boxes(corners, size)
    counts = np.prod(np.maximum(high - low + 1, 0), axis=1)
    drawn, corners, low, high = (x[counts > 0] for x in (drawn, corners, low, high))
    buffer = ZBuffer(size, len(faces))
    for part in chunks(counts[counts > 0]):
        box = low[part], high[part]
        _fill(buffer, drawn[part], corners[part], *box)
    return buffer.items()


class ZBuffer:
    """The nearest item per pixel, kept as one integer: depth above, item below."""

    def __init__(self, size, num_items: int):
        self.size, self.num_items = size, num_items
        self._keys = np.full(size[0] * size[1], np.iinfo(np.uint64).max, np.uint64)

    def put(self, pixels, depth, items):
        """Offer items at flat pixel indices, at positive depths."""
        # The bits of positive floats are ordered as the floats are.
        bits = depth.astype(np.float32).view(np.uint32).astype(np.uint64)
        np.minimum.at(self._keys, pixels, (bits << np.uint64(32)) | items.astype("u8"))

    def items(self) -> np.ndarray:
        """The nearest items [h, w]; `num_items` where there is none."""
        low = self._keys & np.uint64(0xFFFFFFFF)
        return np.minimum(low, np.uint64(self.num_items)).astype(int).reshape(self.size)


def chunks(counts):
    """Slices of items with about `_CHUNK` fragments each."""
    ends = np.cumsum(counts)
    if len(ends) == 0:
        return
    cuts = np.searchsorted(ends, np.arange(_CHUNK, ends[-1], _CHUNK))
    borders = np.unique(np.concatenate([[0], cuts, [len(counts)]]))
    for start, stop in zip(borders[:-1], borders[1:], strict=True):
        yield slice(start, stop)


def fragments(low, high):
    """(item, column, row) of every pixel of every box [low, high] (both inclusive)."""
    wide, tall = (high - low + 1).T
    counts = wide * tall
    item = np.repeat(np.arange(len(low)), counts)
    rank = np.arange(len(item)) - np.repeat(np.cumsum(counts) - counts, counts)
    return item, low[item, 0] + rank % wide[item], low[item, 1] + rank // wide[item]


def _pixels(vertices, camera, size):
    return np.asarray(camera.pixels(np.asarray(vertices), size), np.float64)


def _boxes(corners, size):
    last = np.array([size[1] - 1, size[0] - 1])
    low = np.ceil(np.clip(corners[..., :2].min(axis=1), 0, last + 1))
    high = np.floor(np.clip(corners[..., :2].max(axis=1), -1, last))
    return low.astype(int), high.astype(int)


def _fill(buffer, faces, corners, low, high):
    item, column, row = fragments(low, high)
    x, y, depth = np.moveaxis(corners, -1, 0)
    ahead, behind = [1, 2, 0], [2, 0, 1]
    # Edge functions: twice the signed areas of the pixel with each edge.
    areas = [
        (x[item, a] - column) * (y[item, b] - row)
        - (x[item, b] - column) * (y[item, a] - row)
        for a, b in zip(ahead, behind, strict=True)
    ]
    total = areas[0] + areas[1] + areas[2]
    inside = (np.stack(areas) * total >= 0).all(axis=0) & (total != 0)
    # 1/depth is linear in the picture.
    weighted = sum(area / depth[item, k] for k, area in enumerate(areas))[inside]
    nearest = total[inside] / weighted
    buffer.put((row * buffer.size[1] + column)[inside], nearest, faces[item[inside]])
