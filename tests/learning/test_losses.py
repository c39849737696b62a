"""Gradients of every loss, and no influence of padding."""

import importlib.util
import pathlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import PointCloud, learning

_SPEC = importlib.util.spec_from_file_location(
    "learning_tiny", pathlib.Path(__file__).with_name("tiny.py")
)
tiny = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(tiny)
CODE = tiny.CODE
SMALL = tiny.SMALL
ellipsoid_cloud = tiny.ellipsoid_cloud
networks = tiny.networks
padded = tiny.padded
shaken = tiny.shaken

KEY = jax.random.key(7)


def _cases():
    """(model, loss, data) for every loss."""
    cloud = ellipsoid_cloud()
    rng = np.random.default_rng(1)
    samples = learning.Samples(
        rng.uniform(-0.5, 0.5, (50, 3)), rng.uniform(-0.1, 0.1, 50)
    )
    many = jax.tree.map(lambda x: np.stack([x, x + 0.01, x - 0.02]), samples)
    clouds = jax.tree.map(lambda x: np.stack([x, x, x]), cloud)
    nets = networks()
    decoder = nets["latent"].decoder
    family = learning.Family.create(3, decoder, key=KEY)
    encoder = learning.PointEncoder.create(CODE, key=KEY, width=SMALL["width"])
    return {
        "surface": (nets["siren"], learning.SurfaceLoss(batch=16), cloud),
        "bare surface": (
            nets["fourier"],
            learning.SurfaceLoss(batch=16),
            PointCloud(cloud.points),
        ),
        "distance": (nets["fourier"], learning.DistanceLoss(batch=16), samples),
        "unsigned": (nets["unsigned"], learning.DistanceLoss(batch=16), samples),
        "occupancy": (nets["siren"], learning.OccupancyLoss(batch=16), samples),
        "family": (family, learning.FamilyLoss(shapes=2, batch=8), many),
        "code": (jnp.zeros(CODE), learning.CodeLoss(batch=16), (decoder, cloud)),
        "encoded": (
            learning.EncodedFamily(encoder, decoder),
            learning.EncodedLoss(shapes=2, batch=8, points=9),
            (many, clouds),
        ),
    }


def _without_frequencies(along):
    """The direction with zeros for the frequencies, which are not learned."""
    fixed = lambda x: isinstance(x, learning.FourierFeatures)
    still = lambda x: jax.tree.map(jnp.zeros_like, x) if fixed(x) else x
    return jax.tree.map(still, along, is_leaf=fixed)


# The others are made of the same parts.
_QUICK = ("surface", "code")
_MEMBERS = [
    name if name in _QUICK else pytest.param(name, marks=pytest.mark.slow)
    for name in (
        *_QUICK,
        "distance",
        "family",
        "bare surface",
        "unsigned",
        "occupancy",
        "encoded",
    )
]


@pytest.mark.parametrize("name", _MEMBERS)
def test_gradients_are_central_differences(name, x64):
    model, loss, data = _cases()[name]
    wide = lambda x: jnp.asarray(x, float) if eqx.is_inexact_array(x) else x
    model, data = jax.tree.map(wide, (shaken(model), data))
    if name == "code":
        data = (shaken(data[0], 8), data[1])
    rng = np.random.default_rng(2)
    arrays, rest = eqx.partition(model, eqx.is_inexact_array)
    along = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), arrays)
    along = _without_frequencies(along)

    @jax.jit
    def both(arrays, along, data):
        value = lambda t: loss(
            eqx.combine(jax.tree.map(lambda x, d: x + t * d, arrays, along), rest),
            data,
            KEY,
        )
        h = 1e-6
        up, down = jax.vmap(value)(jnp.asarray([h, -h]))
        return jax.grad(value)(0.0), (up - down) / (2 * h)

    exact, differences = both(arrays, along, data)
    assert abs(exact) > 1e-3
    np.testing.assert_allclose(exact, differences, rtol=1e-5)


@pytest.mark.parametrize("name", ["surface", "code"])
def test_padding_has_no_influence(name):
    model, loss, data = _cases()[name]
    model = shaken(model)
    cloud = ellipsoid_cloud()
    single = lambda x: jax.tree.map(
        lambda y: jnp.asarray(y, jnp.float32) if y.dtype == np.float64 else y, x
    )
    rest = (lambda c: (shaken(data[0], 8), c)) if name == "code" else (lambda c: c)

    def run(points, normals, mask):
        return loss(model, rest(PointCloud(points, normals, mask)), KEY)

    both = jax.jit(jax.value_and_grad(run))
    plain, more = single(cloud), single(padded(cloud, 5))
    value = jax.jit(run)(plain.points, plain.normals, plain.mask)
    same, slope = both(more.points, more.normals, more.mask)
    np.testing.assert_allclose(value, same, rtol=1e-6)
    assert np.all(np.asarray(slope)[40:] == 0) and np.all(np.isfinite(slope))
    assert np.any(np.asarray(slope)[:40] != 0)
    nothing, still = both(more.points, more.normals, jnp.zeros(45, bool))
    assert np.isfinite(nothing) and np.all(still == 0)


@pytest.mark.slow
def test_the_encoder_reads_a_set():
    cloud = jax.tree.map(jnp.asarray, ellipsoid_cloud())
    points = cloud.points.astype(jnp.float32)
    encoder = learning.PointEncoder.create(CODE, key=KEY, width=16)
    code = jax.jit(lambda p, m: encoder(PointCloud(p, None, m)))
    full = code(points, jnp.ones(40, bool))
    order = np.random.default_rng(0).permutation(40)
    # The maximum has no rounding; products of matrices may order their sums anew.
    np.testing.assert_allclose(code(points[order], jnp.ones(40, bool)), full, rtol=1e-5)
    more = jnp.concatenate([points, jnp.full((6, 3), jnp.nan)])
    mask = jnp.arange(46) < 40
    np.testing.assert_allclose(code(more, mask), full, rtol=1e-5)
    slope = jax.jit(jax.jacrev(code))(more, mask)
    assert np.all(slope[:, 40:] == 0) and np.all(np.isfinite(slope))
    assert np.any(slope[:, :40] != 0)
    moved = jnp.concatenate([points, jnp.full((6, 3), 0.7)])
    assert np.array_equal(code(moved, mask), code(more, mask))
    assert np.all(np.isfinite(code(more, jnp.zeros(46, bool))))
