"""Laws of the parts an alignment is composed of: kernels, objectives, models."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import Affine, Rigid, Similarity
from jaxgeom.registration import (
    L2,
    AffineModel,
    AnnealedWidth,
    Cauchy,
    FixedWidth,
    GemanMcClure,
    Generalized,
    Huber,
    Pair,
    PointToPlane,
    PointToPoint,
    QuantileWidth,
    RigidModel,
    SimilarityModel,
    Symmetric,
    Trimmed,
    Tukey,
    Welsch,
    deviation_width,
    planar,
    rotation_about,
    translation_only,
    yaw,
)
from jaxgeom.registration._models import tangent_of

KERNELS = [L2, Huber, Cauchy, GemanMcClure, Tukey, Welsch, Trimmed]
OBJECTIVES = [PointToPoint, PointToPlane, Symmetric, Generalized]
MODELS = [RigidModel, SimilarityModel, AffineModel]


@pytest.mark.parametrize("kind", KERNELS)
def test_weight_is_the_slope_of_rho_over_r(kind, x64):
    kernel, width = kind(), 0.7
    cost = lambda r: width**2 * kernel.rho(r**2 / width**2) / 2
    r = jnp.asarray([1e-9, 0.03, 0.41, 0.69, 0.71, 1.3, 40.0])
    step = 1e-7 * jnp.maximum(r, 1e-3)
    slope = (cost(r + step) - cost(r - step)) / (2 * step)
    weights = kernel.weight(r**2 / width**2)
    # Below the step size a difference says nothing: there the weight is one.
    np.testing.assert_allclose(weights[1:], (slope / r)[1:], rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(kernel.weight(jnp.zeros(1)), 1)
    assert np.all(np.diff(weights) <= 0) and np.all(np.isfinite(weights))
    assert kernel.rho(jnp.zeros(())) == 0
    tiny = jnp.asarray([1e-30, 1e-12], jnp.float32)
    np.testing.assert_allclose(kernel.rho(tiny) / tiny, 1, rtol=1e-6)


@pytest.mark.parametrize("kind", KERNELS)
def test_weights_have_finite_slopes_at_zero_and_far_away(kind):
    slope = jax.vmap(jax.grad(lambda s: kind().weight(s)))
    assert np.all(np.isfinite(slope(jnp.asarray([0.0, 1e-30, 1.0, 1e12]))))


@pytest.mark.parametrize(
    "width", [QuantileWidth(0.7, 2.0), deviation_width(), AnnealedWidth(0.0)]
)
def test_widths_scale_with_the_residuals(width):
    squares = np.random.default_rng(2).chisquare(1, 301).astype(np.float32)
    mask, first = np.arange(301) < 250, np.float32(np.inf)
    unit, large = (width(c * squares, mask, first) for c in (1, 16))
    np.testing.assert_allclose(large, 4 * unit, rtol=1e-5)
    padded = width(np.where(mask, squares, 1e6).astype(np.float32), mask, first)
    np.testing.assert_allclose(padded, unit, rtol=1e-5)


def test_widths_are_what_they_say():
    rng = np.random.default_rng(3)
    r = np.abs(0.3 * rng.normal(size=20_001)).astype(np.float32)
    r[:4000] = 50
    mask, first = np.ones(len(r), bool), np.float32(np.inf)
    np.testing.assert_allclose(
        QuantileWidth(0.4)(r**2, mask, first), np.quantile(r, 0.4), rtol=1e-3
    )
    clean = deviation_width(1.0)(r[4000:] ** 2, mask[4000:], first)
    np.testing.assert_allclose(clean, 0.3, rtol=0.03)
    assert QuantileWidth(0.4, least=7.0)(r**2, mask, first) == 7
    assert QuantileWidth(0.4)(r**2, mask, np.float32(0.01)) == np.float32(0.01)
    annealed = AnnealedWidth(0.05, start=3, decay=0.5)
    start = annealed(r**2, mask, first)
    np.testing.assert_allclose(start, 3 * np.median(r), rtol=1e-3)
    np.testing.assert_allclose(annealed(r**2, mask, start), start / 2)
    assert annealed(r**2, mask, np.float32(0.06)) == np.float32(0.05)
    assert FixedWidth(0.2)(r**2, mask, first) == np.float32(0.2)
    assert isinstance(Tukey(0.2).width, FixedWidth)


def _pair(rng, aligned=False):
    unit = lambda x: x / np.linalg.norm(x)
    normal = unit(rng.normal(size=3))
    other = normal if aligned else unit(normal + 0.4 * rng.normal(size=3))
    return Pair(
        *map(jnp.asarray, (rng.normal(size=3), normal, rng.normal(size=3), other))
    )


@pytest.mark.parametrize("kind", OBJECTIVES)
def test_objectives_do_not_see_common_motions(kind, x64):
    rng = np.random.default_rng(4)
    pair, move = _pair(rng), Rigid.exp(jnp.asarray(rng.normal(size=6)))
    moved = Pair(
        move(pair.point),
        move.normals(pair.normal),
        move(pair.there),
        move.normals(pair.there_normal),
    )
    length = lambda pair: jnp.sum(kind().residual(pair) ** 2)
    np.testing.assert_allclose(length(moved), length(pair), rtol=1e-12)
    same = Pair(pair.there, pair.normal, pair.there, pair.there_normal)
    np.testing.assert_allclose(kind().residual(same), 0, atol=1e-15)
    flipped = Pair(pair.point, pair.normal, pair.there, -pair.there_normal)
    np.testing.assert_allclose(length(flipped), length(pair), rtol=1e-12)


@pytest.mark.parametrize("aligned", [False, True])
def test_generalized_is_the_metric_of_two_patches(aligned, x64):
    pair = _pair(np.random.default_rng(5), aligned)
    objective = Generalized(thickness=0.02)
    patch = lambda n: np.eye(3) - (1 - 0.02) * np.outer(n, n)
    metric = np.linalg.inv(patch(pair.normal) + patch(pair.there_normal))
    expected = 2 * 0.02 * pair.gap @ metric @ pair.gap
    np.testing.assert_allclose(
        jnp.sum(objective.residual(pair) ** 2), expected, rtol=1e-10
    )
    slope = jax.grad(lambda p: jnp.sum(objective.residual(p) ** 2))(pair)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slope))


@pytest.mark.parametrize("kind", MODELS)
def test_generators_are_the_slopes_of_exp(kind, x64):
    model, rng = kind(), np.random.default_rng(6)
    xi, x = jnp.asarray(rng.normal(size=model.dof)), jnp.asarray(rng.normal(size=3))
    step = 1e-6
    moved = (model.exp(step * xi)(x) - model.exp(-step * xi)(x)) / (2 * step)
    matrix, shift = model.generator(xi)
    np.testing.assert_allclose(moved, matrix @ x + shift, atol=1e-9)
    a, b = model.exp(0.1 * xi), model.exp(0.1 * xi)
    np.testing.assert_allclose(model.difference(a, b), 0, atol=1e-12)


@pytest.mark.parametrize("kind", MODELS)
def test_steps_about_the_center_are_steps_about_the_origin(kind, x64):
    rng = np.random.default_rng(7)
    center, size = jnp.asarray([3.0, -5.0, 2.0]), jnp.asarray(0.3)
    model = kind()
    tangent = tangent_of(model, center, size)
    z = jnp.asarray(0.1 * rng.normal(size=model.dof))
    x = jnp.asarray(rng.normal(size=3))
    about_center = model.exp(tangent.basis @ z)(x - center) + center
    about_origin = model.exp(tangent.about_origin @ z)(x)
    np.testing.assert_allclose(about_center, about_origin, atol=1e-12)
    back = tangent.from_origin @ tangent.about_origin @ z
    np.testing.assert_allclose(back, z, atol=1e-12)


def test_locked_directions():
    axis, point = np.array([1.0, 2.0, -2.0]) / 3, np.array([0.5, -1.0, 2.0])
    turn = Rigid.exp(yaw(axis) @ jnp.asarray([0.8, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(turn(axis), axis, atol=1e-6)
    about = Rigid.exp(rotation_about(point) @ jnp.asarray([0.8, -0.2, 0.4]))
    np.testing.assert_allclose(about(point), point, atol=1e-6)
    flat = Rigid.exp(planar(axis) @ jnp.asarray([0.8, -0.2, 0.4]))
    np.testing.assert_allclose(flat(point) @ axis, point @ axis, atol=1e-6)
    shift = Rigid.exp(translation_only() @ jnp.asarray([0.8, -0.2, 0.4]))
    np.testing.assert_allclose(shift.rotation, np.eye(3))


def test_models_take_simpler_transforms():
    motion = Rigid.exp(jnp.asarray([0.3, -0.2, 0.1, 1.0, 2.0, 3.0]))
    x = np.array([0.4, 0.7, -2.0], np.float32)
    for model, kind in ((SimilarityModel(), Similarity), (AffineModel(), Affine)):
        cast = model.cast(motion)
        assert isinstance(cast, kind)
        np.testing.assert_allclose(cast(x), motion(x), rtol=1e-6)
