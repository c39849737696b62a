"""Pictures of fields, by sphere tracing."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..fields import Camera, lipschitz, normal
from ._lighting import AmbientOcclusion, SoftShadows
from ._shading import CLAY, Seen, key_light, shade

_CHUNK = 16384
_BURST = 8


def render_field(
    field: Callable,
    camera: Camera,
    *,
    size: tuple[int, int],
    color=CLAY,
    samples: int = 2,
    max_steps: int = 192,
    shadows: SoftShadows | None = None,
    occlusion: AmbientOcclusion | None = None,
) -> np.ndarray:
    """The picture uint8 [h, w, 3] of a field (host).

    Steps are f / L, with the Lipschitz constant L that the field claims, or 1 where it
    claims none: then it must be a distance or a lower bound.

    **Arguments:**

    - `size`: (height, width) in pixels.
    - `color`: (red, green, blue) in [0, 1].
    - `samples`: rays along each side of a pixel, averaged.
    - `shadows`, `occlusion`: how light is kept off; None, and nothing is.

    A ray ends at three times the distance from camera to target.
    """
    fine = (samples * size[0], samples * size[1])
    directions = np.asarray(camera.directions(fine)).reshape(-1, 3)
    far = 3 * float(np.linalg.norm(np.asarray(camera.target - camera.position)))
    # A twentieth of a pixel at the target is nearer than the eye can tell.
    near = far / 60 / float(camera.focal(fine[0]))
    steep = lipschitz(field)
    known = jnp.isfinite(steep) & (steep > 0)
    slowed = _Slowed(field, jnp.where(known, steep, 1.0))
    t, hit = _march(slowed, camera, directions, near, far, max_steps)
    normals = np.zeros_like(directions)
    position = np.asarray(camera.position)
    points = position + t[hit, None] * directions[hit]
    normals[hit] = _in_chunks(lambda x: _normals(field, x), points)
    lamp = key_light(np.asarray(camera.axes(), np.float32))
    lights = np.ones((len(hit), 2), np.float32)
    lights[hit] = _in_chunks(
        lambda x, n: _lights(slowed, (shadows, occlusion), lamp, far / 3, x, n),
        points,
        normals[hit],
    )
    lit, sky = np.moveaxis(lights.reshape(*fine, 2, 1), 2, 0)
    planes = [x.reshape(*fine, 3) for x in (normals, directions)]
    colors = np.broadcast_to(np.float32(color), planes[0].shape)
    return shade(Seen(hit.reshape(fine), *planes, colors, lit, sky), camera, samples)


class _Slowed(eqx.Module):
    """f / L."""

    field: Callable
    constant: jax.Array

    def __call__(self, point):
        return self.field(point) / self.constant.astype(point.dtype)


@eqx.filter_jit
def _lights(field, settings, lamp, reach, points, normals):
    """The parts [n, 2] of the key light and of the sky that arrive."""
    shadows, occlusion = settings
    one = jnp.ones(len(points), points.dtype)
    shaded = lambda x, n: shadows.light(field, x + n * reach / 512, lamp, reach)
    hidden = lambda x, n: occlusion.light(field, x, n)
    lit = one if shadows is None else jax.vmap(shaded)(points, normals)
    sky = one if occlusion is None else jax.vmap(hidden)(points, normals)
    return jnp.stack([lit, sky], axis=1)


def _march(field, camera, directions, near, far, max_steps):
    """(t, hit) of all rays. Finished rays are dropped between bursts of steps: under
    `vmap` alone, every ray would go on for as long as the slowest."""
    t = np.zeros(len(directions), directions.dtype)
    f = np.full_like(t, field(camera.position))
    limits = np.asarray([near, far], directions.dtype)
    advance = lambda d, t, f: _burst(field, camera.position, limits, d, t, f)
    going = np.arange(len(t))
    for _ in range(0, max_steps, _BURST):
        t[going], f[going] = _in_chunks(advance, directions[going], t[going], f[going])
        going = going[(f[going] > near) & (t[going] <= far)]
        if len(going) == 0:
            break
    return t, (f <= near) & (t <= far)


@eqx.filter_jit
def _burst(field, origin, limits, directions, t, f):
    near, far = limits

    def advance(_, state):
        t, f = state
        t = t + jnp.where((f > near) & (t <= far), f, 0)
        return t, jax.vmap(field)(origin + t[:, None] * directions)

    return jax.lax.fori_loop(0, _BURST, advance, (t, f))


@eqx.filter_jit
def _normals(field, points):
    return jax.vmap(lambda x: normal(field, x))(points)


def _in_chunks(function, *arrays):
    """`function` of rows, a fixed number at a time: one program for any number."""
    starts = range(0, len(arrays[0]), _CHUNK)
    parts = [_one_chunk(function, [x[i : i + _CHUNK] for x in arrays]) for i in starts]
    return jax.tree.map(lambda *x: np.concatenate(x), *parts) if parts else arrays[0]


def _one_chunk(function, rows):
    count = len(rows[0])
    padded = [np.pad(x, [(0, _CHUNK - count)] + [(0, 0)] * (x.ndim - 1)) for x in rows]
    return jax.tree.map(lambda x: np.asarray(x)[:count], function(*padded))
