"""Rays through fields that are steeper than a distance."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import fields as jf

ORIGIN = jnp.array([2.0, 0.3, 0.2])
STEEP = 3.0


def steep(p):
    return STEEP * jf.Sphere(0.6)(p)


def traced(field, targets, **settings):
    trace = lambda d: jf.sphere_trace(field, ORIGIN, d, max_distance=6.0, **settings)
    return jax.jit(jax.vmap(trace))(targets - ORIGIN)


def test_a_steep_field_needs_its_constant(x64):
    targets = jnp.asarray(np.random.default_rng(0).uniform(-0.7, 0.7, (64, 3)))
    right = traced(jf.Sphere(0.6), targets)
    claimed = traced(jf.declare(steep, lipschitz=STEEP), targets)
    given = traced(steep, targets, lipschitz=STEEP)
    assert 0.3 < right.hit.mean() < 1
    for hits in (claimed, given):
        np.testing.assert_array_equal(hits.hit, right.hit)
        np.testing.assert_allclose(hits.distance, right.distance, atol=1e-9)
        np.testing.assert_array_equal(hits.steps, right.steps)
    # Without the constant rays jump into the body or over it.
    wrong = traced(steep, targets)
    off = np.abs(wrong.distance - right.distance)[np.asarray(right.hit)]
    assert np.median(off) > 0.1
