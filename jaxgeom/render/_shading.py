"""From what each pixel sees to a picture: one look for fields, meshes and clouds."""

from typing import NamedTuple

import numpy as np

from ..fields import Camera

CLAY = (0.80, 0.69, 0.58)
_PAPER = np.array([0.93, 0.94, 0.955])
_DUSK = np.array([0.74, 0.77, 0.81])
_GAMMA = 2.2


class Seen(NamedTuple):
    """What the pixels [h, w] of a picture see, at `samples` pixels per output pixel.

    `hit` [h, w]; unit normals [h, w, 3], directions of the rays [h, w, 3] and colors
    [h, w, 3] in [0, 1], which mean nothing where `hit` is False. `lit` and `open`
    [h, w, 1] are the parts of the key light and of the sky that arrive.
    """

    hit: np.ndarray
    normals: np.ndarray
    directions: np.ndarray
    colors: np.ndarray
    lit: np.ndarray | float = 1.0
    open: np.ndarray | float = 1.0


def shade(seen: Seen, camera: Camera, samples: int) -> np.ndarray:
    """uint8 [h, w, 3]: a key and a fill light, ambient light from above, a soft rim."""
    light = _radiance(seen, np.asarray(camera.axes(), np.float32), _up(camera))
    picture = np.where(seen.hit[..., None], light, _background(seen.hit.shape))
    return _encode(_average(picture, samples))


def _radiance(seen, axes, up):
    right, above, forward = axes
    # A normal turned away from the eye belongs to an open surface seen from behind.
    facing = np.sum(seen.normals * seen.directions, axis=-1, keepdims=True)
    normals = np.where(facing > 0, -seen.normals, seen.normals)
    eye = np.clip(np.abs(facing), 0, 1)
    key = key_light(axes)
    fill = _unit(0.9 * right + 0.15 * above - 0.5 * forward)
    lambert = np.clip(normals @ key, 0, None)[..., None]
    filled = np.clip(normals @ fill, 0, None)[..., None]
    ambient = 0.5 + 0.5 * (normals @ up)[..., None]
    halfway = normals @ key[:, None] * 2 * normals - key
    shine = np.clip(-np.sum(halfway * seen.directions, axis=-1, keepdims=True), 0, 1)
    albedo = np.asarray(seen.colors, np.float32) ** _GAMMA
    warm, cool = np.float32([1.0, 0.96, 0.90]), np.float32([0.80, 0.90, 1.0])
    diffuse = 1.05 * seen.lit * lambert * warm + 0.22 * filled * cool
    sky = seen.open * (0.04 + 0.16 * ambient) * cool
    return (
        albedo * (diffuse + sky)
        + 0.07 * seen.lit * shine**24
        + 0.22 * (1 - eye) ** 3 * cool
    )


def key_light(axes) -> np.ndarray:
    """The direction to the key light, given the axes of a camera."""
    right, above, forward = axes
    return _unit(-0.55 * right + 0.75 * above - 0.75 * forward)


def _up(camera):
    return _unit(np.asarray(camera.up, np.float32))


def _unit(v):
    return (v / np.linalg.norm(v)).astype(np.float32)


def _background(shape):
    height, width = shape
    row, column = np.mgrid[0:height, 0:width].astype(np.float32)
    x, y = (column + 0.5) / width - 0.5, (row + 0.5) / height - 0.42
    fade = np.clip(1.5 * (x * x + y * y), 0, 1)[..., None]
    return ((1 - fade) * _PAPER + fade * _DUSK).astype(np.float32) ** _GAMMA


def _average(picture, samples):
    height, width = picture.shape[0] // samples, picture.shape[1] // samples
    blocks = picture.reshape(height, samples, width, samples, 3)
    return blocks.mean(axis=(1, 3))


def _encode(linear):
    return np.round(255 * np.clip(linear, 0, 1) ** (1 / _GAMMA)).astype(np.uint8)
