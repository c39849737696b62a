"""The training loop: one program, one result per key, statuses, batches."""

import importlib.util
import pathlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import RESULTS, PointCloud, fields, learning

_SPEC = importlib.util.spec_from_file_location(
    "learning_tiny", pathlib.Path(__file__).with_name("tiny.py")
)
tiny = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(tiny)
SMALL = tiny.SMALL
ellipsoid_cloud = tiny.ellipsoid_cloud
networks = tiny.networks

KEY = jax.random.key(11)
LOSS = learning.SurfaceLoss(batch=32)


def _single(cloud):
    cast = lambda x: jnp.asarray(x, jnp.float32) if x.dtype == np.float64 else x
    return jax.tree.map(cast, cloud)


CLOUD = _single(ellipsoid_cloud())


def _leaves(model):
    return jax.tree.leaves(eqx.filter(model, eqx.is_inexact_array))


def _same(a, b):
    return all(
        np.array_equal(x, y) for x, y in zip(_leaves(a), _leaves(b), strict=True)
    )


@pytest.mark.parametrize("name", networks())
def test_networks_are_fields_that_start_as_a_sphere(name):
    field = networks()[name]
    radius = 0.3 if name in ("siren", "unsigned") else 0.35
    directions = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    on = radius * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    look = jax.jit(jax.vmap(jax.value_and_grad(lambda p: field(p))))
    values = look(jnp.asarray(on))[0]
    np.testing.assert_allclose(values, 0, atol=1e-6)
    outer = look(jnp.asarray(1.3 * on))[0]
    alone = field(jnp.asarray(1.3 * on[0]))
    np.testing.assert_allclose(alone, outer[0], rtol=1e-5)
    assert alone.dtype == jnp.float32 and np.all(outer > 0.05)
    inner, slopes = look(jnp.asarray(0.4 * on))
    assert np.all(inner > 0.05) if name == "unsigned" else np.all(inner < -0.05)
    assert np.all(np.isfinite(slopes))
    assert np.all(np.isfinite(look(jnp.zeros((5, 3)))[1]))


def test_training_is_one_program_and_depends_on_the_key_alone():
    net = networks()["siren"]
    seen = []
    progress = lambda done, loss: seen.append((done, loss))
    adam = learning.Adam(num_steps=130, rate=3e-3)
    first = learning.train(net, LOSS, CLOUD, key=KEY, adam=adam, progress=progress)
    assert [done for done, _ in seen] == [100, 130]
    assert seen[-1][1] == float(first.losses[-1])
    before = learning._training._chunk._cached._cache_size()
    again = learning.train(net, LOSS, CLOUD, key=KEY, adam=adam)
    assert _same(first.model, again.model)
    other = learning.Adam(num_steps=90, rate=2e-3)
    shorter = learning.train(
        net, LOSS, _single(ellipsoid_cloud(seed=4)), key=jax.random.key(2), adam=other
    )
    assert learning._training._chunk._cached._cache_size() == before
    assert not _same(first.model, shorter.model)
    assert first.result == RESULTS.successful
    assert float(first.losses[-10:].mean()) < 0.7 * float(first.losses[:10].mean())


@pytest.mark.slow
def test_a_batch_of_shapes_is_a_loop_of_shapes():
    nets = [learning.NeuralField.siren(key=jax.random.key(s), **SMALL) for s in (1, 2)]
    clouds = [CLOUD, _single(ellipsoid_cloud(seed=9))]
    keys = jax.random.split(KEY, 2)
    adam = learning.Adam(num_steps=12, rate=3e-3)
    stack = lambda *x: jax.tree.map(lambda *y: jnp.stack(y), *x)
    run = lambda net, cloud, key: learning.train_jit(
        net, LOSS, cloud, key=key, adam=adam
    )
    many = jax.jit(jax.vmap(run))(stack(*nets), stack(*clouds), keys)
    for i in range(2):
        one = learning.train(nets[i], LOSS, clouds[i], key=keys[i], adam=adam)
        np.testing.assert_allclose(many.losses[i], one.losses, rtol=2e-3)
        for x, y in zip(_leaves(many.model), _leaves(one.model), strict=True):
            np.testing.assert_allclose(x[i], y, atol=2e-3)


def test_bad_training_has_a_status_and_finite_weights():
    net = networks()["siren"]
    broken = PointCloud(CLOUD.points.at[3].set(jnp.nan), CLOUD.normals)
    adam = learning.Adam(num_steps=20)
    out = learning.train(net, LOSS, broken, key=KEY, adam=adam)
    assert out.result == RESULTS.diverged
    assert 0 < int(out.num_skipped) <= 20
    assert all(np.all(np.isfinite(x)) for x in _leaves(out.model))
    masked = PointCloud(broken.points, CLOUD.normals, jnp.arange(40) != 3)
    assert learning.train(net, LOSS, masked, key=KEY, adam=adam).num_skipped == 0


def _bowl(x, data, key):
    return jnp.sum((x - data) ** 2)


def test_adam_finds_a_minimum_or_says_that_it_did_not():
    target = jnp.asarray([0.3, -0.7])
    run = lambda **kw: learning.train(
        jnp.zeros(2), _bowl, target, key=KEY, adam=learning.Adam(num_steps=400, **kw)
    )
    found = run(rate=2e-2)
    assert found.result == RESULTS.successful
    np.testing.assert_allclose(found.model, target, atol=1e-3)
    assert run(rate=0.0).result == RESULTS.not_converged
    assert run(rate=1e30).result == RESULTS.diverged
    with pytest.raises(ValueError, match="at least 1 step"):
        learning.Adam(num_steps=0)


@pytest.mark.slow
def test_occupancy_is_a_field_at_level_zero():
    body = fields.Ellipsoid((0.4, 0.3, 0.2), (0.05, 0, -0.02))
    points = jax.random.uniform(KEY, (8000, 3), minval=-0.6, maxval=0.6)
    samples = learning.Samples(points, jax.vmap(body)(points))
    net = learning.NeuralField.siren(key=KEY, width=32, frequency=8.0)
    adam = learning.Adam(num_steps=800)
    out = learning.train(net, learning.OccupancyLoss(), samples, key=KEY, adam=adam)
    fresh = jax.random.uniform(jax.random.key(5), (4000, 3), minval=-0.6, maxval=0.6)
    right = (jax.vmap(out.model)(fresh) < 0) == (jax.vmap(body)(fresh) < 0)
    assert float(jnp.mean(right)) > 0.99
    chance = fields.SoftOccupancy(out.model, 1.0)
    assert chance(jnp.asarray([0.05, 0, 0])) > 0.9 > 0.1 > chance(jnp.full(3, 0.5))
