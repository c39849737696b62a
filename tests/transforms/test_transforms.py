"""Laws of the three groups, over one table."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxgeom.shapes import PointCloud, TriangleMesh
from jaxgeom.transforms import Affine, Rigid, Similarity, rotation_exp, rotation_log

GROUPS = [(Rigid, 6), (Similarity, 7), (Affine, 12)]
POINTS = np.random.default_rng(3).normal(size=(11, 3)) * 2.5 + 0.7


def _draw(group, size, seed):
    return group.exp(jnp.asarray(np.random.default_rng(seed).normal(size=size) * 0.6))


@pytest.mark.parametrize("group, size", GROUPS)
def test_group_laws(group, size, x64):
    a, b = _draw(group, size, 0), _draw(group, size, 1)
    np.testing.assert_allclose((a @ b)(POINTS), a(b(POINTS)), atol=1e-12)
    np.testing.assert_allclose(a.inverse()(a(POINTS)), POINTS, atol=1e-12)
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-12)
    np.testing.assert_allclose(group.identity()(POINTS), POINTS)


@pytest.mark.parametrize("group, size", GROUPS)
@pytest.mark.parametrize("length", [0.0, 1e-9, 1e-3, 1.9])
def test_log_inverts_exp(group, size, length, x64):
    tangent = np.random.default_rng(7).normal(size=size)
    tangent = jnp.asarray(length * tangent / np.linalg.norm(tangent))
    np.testing.assert_allclose(group.exp(tangent).log(), tangent, atol=1e-11)


@pytest.mark.parametrize("angle", [0.0, 1e-10, 1e-4, 1.0, 3.0, np.pi - 1e-7, np.pi])
def test_rotation_against_scipy(angle, x64):
    axis = np.array([2.0, -1.0, 0.5]) / np.linalg.norm([2.0, -1.0, 0.5])
    expected = Rotation.from_rotvec(angle * axis).as_matrix()
    rotation = rotation_exp(jnp.asarray(angle * axis))
    np.testing.assert_allclose(rotation, expected, atol=1e-14)
    turned = rotation_exp(rotation_log(rotation))
    np.testing.assert_allclose(turned, expected, atol=1e-9)


@pytest.mark.parametrize("scale", [0.0, 1e-6, 0.3, 2.8])
def test_exp_derivative_is_central_difference(scale, x64):
    twist = jnp.asarray(scale * np.array([0.4, -0.7, 0.6, 1.0, 2.0, -1.0]))
    image = lambda t: Rigid.exp(t)(jnp.asarray(POINTS))
    forward, reverse = jax.jacfwd(image)(twist), jax.jacrev(image)(twist)
    step = 1e-6 * jnp.eye(6)
    central = jax.vmap(lambda e: (image(twist + e) - image(twist - e)) / 2e-6)(step)
    np.testing.assert_allclose(forward, reverse, atol=1e-12)
    np.testing.assert_allclose(forward, jnp.moveaxis(central, 0, -1), atol=1e-8)
    assert np.isfinite(jax.jacrev(lambda t: Rigid.exp(t).log())(twist)).all()


def test_normals_stay_orthogonal_under_shear(x64):
    shear = _draw(Affine, 12, 5)
    tangent, normal = jnp.asarray([1.0, 2.0, 0.0]), jnp.asarray([2.0, -1.0, 0.3])
    image = shear(tangent) - shear(jnp.zeros(3))
    assert abs(jnp.dot(image, shear.normals(normal))) < 1e-12


def test_moves_clouds_and_meshes():
    rigid = _draw(Rigid, 6, 2)
    cloud = PointCloud(POINTS, POINTS)
    mesh = TriangleMesh(POINTS, np.array([[0, 1, 2]]))
    np.testing.assert_allclose(rigid(cloud).points, rigid(POINTS), rtol=1e-6)
    np.testing.assert_allclose(rigid(mesh).vertices, rigid(POINTS), rtol=1e-6)
    assert rigid(mesh).normals is None
    unit = POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)
    np.testing.assert_allclose(
        rigid(cloud).normals, unit @ np.asarray(rigid.rotation).T, atol=1e-5
    )


def test_batches_by_vmap():
    tangents = jnp.asarray(np.random.default_rng(1).normal(size=(5, 6)), jnp.float32)
    batched = jax.vmap(lambda t: Rigid.exp(t)(jnp.asarray(POINTS, jnp.float32)))(
        tangents
    )
    for row, tangent in zip(batched, tangents, strict=True):
        np.testing.assert_allclose(row, Rigid.exp(tangent)(POINTS), atol=2e-5)


def test_reflection_has_no_affine_logarithm():
    with pytest.raises(ValueError, match="eigenvalue"):
        Affine(jnp.diag(jnp.asarray([1.0, 2.0, -3.0])), jnp.zeros(3)).log()
