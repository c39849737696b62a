"""The sparse operator: values, derivatives, batches, composition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import sparse

from jaxgeom import GeometryError
from jaxgeom.subdivision import CatmullClark, Loop, Refinement, plan_subdivision

from .meshes_for_tests import cube, hull

APPLY = jax.jit(lambda s, x: s @ x)


def loop():
    return plan_subdivision(hull(), 2, scheme=Loop()).operator


def test_the_product_is_that_of_scipy(x64):
    s, generator = loop(), np.random.default_rng(0)
    matrix = s.to_scipy()
    assert s.shape == matrix.shape
    for tail in ((), (3,), (2, 2)):
        x = generator.normal(size=(s.shape[1], *tail))
        want = (matrix @ x.reshape(len(x), -1)).reshape(-1, *tail)
        np.testing.assert_allclose(APPLY(s, x), want, atol=1e-14)
        np.testing.assert_allclose(s @ x, want, atol=1e-14)


def test_precision_follows_the_attribute(x64):
    s = loop()
    x = np.random.default_rng(0).normal(size=(s.shape[1], 3))
    single = s @ jnp.asarray(x, jnp.float32)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, s @ x, atol=1e-6)
    labels = np.arange(s.shape[1])
    assert (s @ labels).dtype == jnp.float64
    np.testing.assert_allclose(s @ labels, s @ labels.astype(float))


def test_derivatives_are_the_matrix(x64):
    s, generator = loop(), np.random.default_rng(0)
    x, g = (
        generator.normal(size=(s.shape[1], 3)),
        generator.normal(size=s.shape[:1] + (3,)),
    )
    matrix = s.to_scipy()
    pull = jax.jit(lambda s, x, g: jax.vjp(lambda x: s @ x, x)[1](g)[0])(s, x, g)
    np.testing.assert_allclose(pull, matrix.T @ g, atol=1e-13)
    push = jax.jit(lambda s, x, t: jax.jvp(lambda x: s @ x, (x,), (t,))[1])(s, x, x**2)
    np.testing.assert_allclose(push, matrix @ x**2, atol=1e-13)


def test_many_shapes_at_once(x64):
    s = loop()
    shapes = np.random.default_rng(0).normal(size=(4, s.shape[1], 3))
    many = jax.jit(jax.vmap(lambda x, s: s @ x, in_axes=(0, None)))(shapes, s)
    np.testing.assert_allclose(many, [APPLY(s, x) for x in shapes], atol=1e-14)


@pytest.mark.parametrize(
    "case", [(hull, Loop()), (cube, CatmullClark())], ids=["loop", "catmull-clark"]
)
def test_levels_compose_and_merge(x64, case):
    mesh, scheme = case[0](), case[1]
    first = plan_subdivision(mesh, 1, scheme=scheme)
    fine = first(mesh)
    second = plan_subdivision(fine, 1, scheme=scheme)
    both = plan_subdivision(mesh, 2, scheme=scheme)
    chained = second.operator @ first.operator
    x = np.asarray(mesh.vertices)
    at_once, step_by_step = both.operator @ x, chained @ x
    for a, b in zip(both.faces, second.faces, strict=True):
        np.testing.assert_allclose(at_once[a], step_by_step[b], atol=1e-14)
    merged = both.operator.merged()
    assert len(merged.factors) == 1 and merged.shape == both.operator.shape
    np.testing.assert_allclose(merged @ x, both.operator @ x, atol=1e-14)


def test_rows_of_very_different_length(x64):
    generator = np.random.default_rng(3)
    dense = sparse.random(40, 30, 0.1, rng=generator).tolil()
    dense[7] = generator.normal(size=30)
    dense[8] = 0
    s = Refinement.from_scipy(dense.tocsr())
    # One full row does not widen all others.
    (band,) = s.factors[0].bands
    assert band.indices.shape[0] < 10 and band.extra_rows.shape[0] > 15
    x = generator.normal(size=(30, 2))
    np.testing.assert_allclose(APPLY(s, x), dense @ x, atol=1e-14)
    np.testing.assert_allclose(s.to_scipy().toarray(), dense.toarray())


def test_a_vertex_that_is_not_finite_spoils_only_its_neighborhood(x64):
    s = loop()
    x = np.array(hull().vertices)
    x[0] = np.nan
    spoilt = np.isnan(np.asarray(APPLY(s, x))).any(axis=1)
    touched = s.to_scipy()[:, 0].toarray()[:, 0] != 0
    np.testing.assert_array_equal(spoilt, touched)


def test_sizes_must_fit():
    with pytest.raises(GeometryError, match="must have .* rows; given"):
        _ = loop() @ np.zeros((3, 3))
    with pytest.raises(GeometryError, match="must have .* rows; given"):
        _ = loop() @ loop()
