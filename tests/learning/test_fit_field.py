"""The door `fit_field`, checkpoints, and families of shapes."""

import importlib.util
import pathlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import (
    RESULTS,
    GeometryError,
    Grid,
    PointCloud,
    fields,
    fit_field,
    io,
    isosurface,
    learning,
)

_SPEC = importlib.util.spec_from_file_location(
    "learning_tiny", pathlib.Path(__file__).with_name("tiny.py")
)
tiny = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(tiny)
SMALL = tiny.SMALL
ellipsoid_cloud = tiny.ellipsoid_cloud
networks = tiny.networks

KEY = jax.random.key(21)
LOSS = learning.SurfaceLoss(batch=32)
ADAM = learning.Adam(num_steps=200, rate=5e-3)
SHIFT, SCALE = np.array([300.0, -20.0, 7.0]), 40.0


def _user_cloud():
    cloud = ellipsoid_cloud()
    return PointCloud(cloud.points * SCALE + SHIFT, cloud.normals)


def test_the_door_returns_a_field_in_the_unit_of_the_points():
    net = networks()["siren"]
    out = fit_field(net, _user_cloud(), key=KEY, loss=LOSS, adam=ADAM, rtol=0.03)
    assert out.result == RESULTS.successful
    assert float(out.error) < 0.03 * 0.9 * SCALE
    line = np.linspace(0, 1.5, 7)[:, None] * np.array([[0.45, 0, 0]]) * SCALE + SHIFT
    values = fields.value(out.field, jnp.asarray(line, jnp.float32))
    assert np.all(values[:4] < 0) and np.all(values[5:] > 0)
    again = fit_field(net, _user_cloud(), key=KEY, loss=LOSS, adam=ADAM, rtol=1e-9)
    assert np.array_equal(again.losses, out.losses)
    assert again.result == RESULTS.not_converged


def test_bad_clouds_are_one_clear_error():
    net, cloud = networks()["siren"], _user_cloud()
    points = cloud.points
    run = lambda p: fit_field(net, p, key=KEY, loss=LOSS, adam=ADAM)
    broken = points.copy()
    broken[3, 1] = np.nan
    for bad, text in (
        (broken, "points must be finite"),
        (points[:1], "at least 4 points"),
        (np.repeat(points[:1], 9, axis=0), "must not all coincide"),
        (points[:, :2], "shape"),
    ):
        with pytest.raises(GeometryError, match=text):
            run(bad)
    wild = learning.Adam(num_steps=20, rate=1e8)
    with pytest.raises(GeometryError, match="Lower Adam"):
        fit_field(net, cloud, key=KEY, loss=LOSS, adam=wild)
    kept = fit_field(net, cloud, key=KEY, loss=LOSS, adam=wild, throw=False)
    assert kept.result == RESULTS.diverged
    twice = jax.tree.map(lambda x: np.concatenate([x[:20], x[:20]]), cloud)
    assert np.isfinite(run(twice).error)


def test_checkpoints_come_back(tmp_path):
    decoder = learning.Decoder.create(3, key=KEY, **SMALL)
    family = learning.Family.create(4, decoder, key=KEY)
    path = tmp_path / "family.npz"
    io.save_weights(path, family)
    blank = learning.Decoder.create(3, key=jax.random.key(0), **SMALL)
    like = learning.Family.create(4, blank, key=jax.random.key(0))
    back = io.load_weights(path, like)
    assert eqx.tree_equal(back, family) and not eqx.tree_equal(like, family)
    with pytest.raises(io.FileError, match="arrays of the model given as `like`"):
        io.load_weights(path, blank)
    other = tmp_path / "other.npz"
    np.savez(other, points=np.zeros((3, 3)))
    (tmp_path / "text.npz").write_text("no weights")
    (tmp_path / "cut.npz").write_bytes(path.read_bytes()[:300])
    for name in ("other.npz", "text.npz", "cut.npz", "missing.npz"):
        with pytest.raises(io.FileError, match="must be a checkpoint"):
            io.load_weights(tmp_path / name, like)
    with pytest.raises(io.FileError, match="can be written"):
        io.save_weights(tmp_path / "no" / "folder.npz", family)


def _eggs(num, seed):
    """Ellipsoids of random axes: samples [s, m], clouds [s, n] and the bodies."""
    axes = jax.random.uniform(jax.random.key(seed), (num, 3), minval=0.15, maxval=0.45)
    points = jax.random.uniform(KEY, (num, 2000, 3), minval=-0.55, maxval=0.55)
    mine = lambda a: fields.Ellipsoid(a)
    ball = jax.random.normal(jax.random.key(seed + 1), (num, 300, 3))
    ball = ball / jnp.linalg.norm(ball, axis=-1, keepdims=True)

    def one(a, p):
        body = mine(a)
        near = lambda q: body(q) / jnp.maximum(jnp.linalg.norm(jax.grad(body)(q)), 0.1)
        return jax.vmap(near)(p)

    values = jax.jit(jax.vmap(one))(axes, points)
    clouds = jax.vmap(PointCloud)(ball * axes[:, None], ball / axes[:, None])
    return learning.Samples(points, values), clouds, axes


@pytest.mark.slow
def test_a_family_explains_a_new_half_cloud():
    samples, clouds, _ = _eggs(48, 1)
    decoder = learning.Decoder.create(4, key=KEY, width=32, num_frequencies=8)
    family = learning.Family.create(48, decoder, key=KEY)
    adam = learning.Adam(num_steps=2000, rate=3e-3)
    out = learning.train(family, learning.FamilyLoss(), samples, key=KEY, adam=adam)
    assert out.result == RESULTS.successful
    encoder = learning.PointEncoder.create(4, key=KEY, width=32)
    pair = learning.EncodedFamily(encoder, out.model.decoder)
    given = (samples, clouds)
    one_pass = learning.train(
        pair, learning.EncodedLoss(), given, key=KEY, adam=adam
    ).model
    _, fresh, axes = _eggs(6, 77)
    half = eqx.tree_at(lambda c: c.mask, fresh, fresh.points[..., 0] > 0)

    @jax.jit
    def errors(cloud, a, key):
        """Mean |f| on the whole true surface: middle of the family, code, encoder."""
        whole = PointCloud(cloud.points)
        model = out.model.decoder
        found = learning.encode_jit(model, cloud, key=key)
        on = lambda f: jnp.mean(jnp.abs(jax.vmap(f)(whole.points)))
        middle = model.field(jnp.zeros(4))
        return on(middle), on(found.field), on(one_pass.field(cloud))

    middle, found, passed = jax.vmap(errors)(half, axes, jax.random.split(KEY, 6))
    assert float(found.mean()) < 0.25 * float(middle.mean())
    assert float(passed.mean()) < 0.5 * float(middle.mean())
    grid = Grid(jnp.full(3, -0.6), jnp.full(3, 0.04), (31, 31, 31))
    code = learning.encode(
        out.model.decoder, jax.tree.map(lambda x: x[0], half), key=KEY
    )
    mesh = isosurface.extract(code.field, grid).mesh
    assert mesh.faces.shape[0] > 500
