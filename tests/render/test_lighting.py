"""Shadows and ambient occlusion fall where they should."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import fields as jf
from jaxgeom import render

UP = jnp.array([0.0, 0.0, 1.0])
FLOOR = jf.Plane((0.0, 0.0, 1.0), 0.0)
BALL = jf.Sphere(0.3, (0.0, 0.0, 0.6))


def test_a_ball_above_a_floor_casts_a_round_shadow():
    scene = BALL | FLOOR
    x = jnp.array([0.0, 0.2, 0.28, 0.35, 0.5, 1.0])
    start = jnp.stack([x, 0 * x, 0 * x + 0.004], axis=1)
    light = render.SoftShadows().light
    seen = jax.jit(jax.vmap(lambda p: light(scene, p, UP, 2.0)))(start)
    assert (seen[:2] < 0.02).all() and (seen[-2:] > 0.95).all()
    assert (np.diff(seen) >= -1e-6).all() and ((seen >= 0) & (seen <= 1)).all()


def test_corners_are_dark_and_planes_are_not():
    wall = jf.Plane((1.0, 0.0, 0.0), 0.0)
    x = jnp.array([0.001, 0.05, 0.15, 0.5])
    points = jnp.stack([x, 0 * x, 0 * x], axis=1)
    light = render.AmbientOcclusion(0.2).light
    seen = jax.jit(jax.vmap(lambda p: light(FLOOR | wall, p, UP)))(points)
    assert (np.diff(seen) > 0).all() and seen[0] < 0.05
    np.testing.assert_allclose(seen[-1], 1, atol=1e-5)


def test_the_picture_gets_darker_only():
    camera = render.Camera((1.5, -3.0, 2.0), (0.0, 0.0, 0.3))
    body = jf.Box((0.9, 0.9, 0.05)) | BALL
    draw = lambda **x: render.render_field(body, camera, size=(40, 56), samples=1, **x)
    plain = draw().astype(int)
    shadowed = draw(shadows=render.SoftShadows()).astype(int)
    both = draw(
        shadows=render.SoftShadows(), occlusion=render.AmbientOcclusion()
    ).astype(int)
    assert (shadowed <= plain).all() and (both <= shadowed).all()
    assert 0.02 < ((plain - shadowed).max(axis=-1) > 20).mean() < 0.4
    assert (both < shadowed).any()
