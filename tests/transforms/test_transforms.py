"""Laws of the three groups, over one table."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxgeom.shapes import PointCloud, TriangleMesh
from jaxgeom.transforms import (
    Affine,
    Rigid,
    Similarity,
    interpolate,
    rotation_exp,
    rotation_log,
)

GROUPS = [(Rigid, 6), (Similarity, 7), (Affine, 12)]
PLANE_GROUPS = [(Rigid, 3), (Similarity, 4), (Affine, 6)]
POINTS = np.random.default_rng(3).normal(size=(11, 3)) * 2.5 + 0.7


def _draw(group, size, seed):
    return group.exp(jnp.asarray(np.random.default_rng(seed).normal(size=size) * 0.6))


@jax.jit
def _log_and_slopes(rotation):
    forward, reverse = jax.jacfwd(rotation_log), jax.jacrev(rotation_log)
    return rotation_log(rotation), forward(rotation), reverse(rotation)


@partial(jax.jit, static_argnums=0)
def _path(group, a, b, times):
    """Matrices along the path between two tangent vectors."""
    return jax.vmap(lambda t: interpolate(group.exp(a), group.exp(b), t).matrix())(
        times
    )


def _points_for(group, size):
    return POINTS[:, :2] if (group, size) in PLANE_GROUPS else POINTS


@pytest.mark.parametrize("group, size", GROUPS + PLANE_GROUPS)
def test_group_laws(group, size, x64):
    a, b = _draw(group, size, 0), _draw(group, size, 1)
    points = _points_for(group, size)
    np.testing.assert_allclose((a @ b)(points), a(b(points)), atol=1e-12)
    np.testing.assert_allclose(a.inverse()(a(points)), points, atol=1e-12)
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-12)
    identity = group.identity(dimension=points.shape[1])
    np.testing.assert_allclose(identity(points), points)


def test_host_arrays_keep_double_precision():
    """The pose of a scan in geographic coordinates, without `jax_enable_x64`."""
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    shift = np.array([450_000.123456789, 5_600_000.987654321, 100.25])
    want = np.vstack([np.column_stack([turn, shift]), [0, 0, 0, 1]])
    for map_ in (Rigid(turn, shift), Affine(turn, shift)):
        np.testing.assert_array_equal(map_.matrix(), want)
        back = (map_ @ map_.inverse()).matrix()
        np.testing.assert_allclose(back, np.eye(4), atol=4e-9)
    scaled = Similarity(np.float64(1.5), turn, shift)
    np.testing.assert_array_equal(scaled.matrix()[:3, 3], shift)
    gone = Affine(np.zeros((3, 3)), shift).inverse()
    assert not np.isfinite(gone.matrix()).any(axis=1)[:3].any()


TIMES = np.array([0.0, 1.0, 0.1, 0.4, 0.6, 0.9, 0.3, 0.7, -0.5])


@pytest.mark.parametrize("group, size", GROUPS + PLANE_GROUPS)
def test_interpolation_is_a_geodesic(group, size, x64):
    a, b, c = (_draw(group, size, seed) for seed in (0, 1, 2))
    if group is Affine:
        path = lambda a, b: np.stack([interpolate(a, b, t).matrix() for t in TIMES])
    else:
        path = lambda a, b: np.asarray(_path(group, a.log(), b.log(), TIMES))
    ab = path(a, b)
    np.testing.assert_allclose(ab[0], a.matrix(), atol=1e-12)
    np.testing.assert_allclose(ab[1], b.matrix(), atol=1e-12)
    # Constant speed: equal steps of time are equal steps of the group.
    step = lambda i, j: np.linalg.inv(ab[i]) @ ab[j]
    np.testing.assert_allclose(step(2, 3), step(4, 5), atol=1e-11)
    np.testing.assert_allclose(step(8, 0), step(2, 4), atol=1e-11)
    # It does not depend on the coordinates, and backwards it is the same path.
    moved = interpolate(c @ a, c @ b, 0.3).matrix()
    np.testing.assert_allclose(moved, c.matrix() @ ab[6], atol=1e-11)
    np.testing.assert_allclose(path(b, a)[6], ab[7], atol=1e-11)


def test_interpolation_wants_one_kind():
    with pytest.raises(ValueError, match="one kind"):
        interpolate(Rigid.identity(), Similarity.identity(), 0.5)


@pytest.mark.parametrize("group, size", [*GROUPS[:2], *PLANE_GROUPS[:2]])
@pytest.mark.parametrize("dtype, atol", [(np.float32, 2e-4), (np.float64, 1e-8)])
def test_logarithm_near_a_half_turn(group, size, dtype, atol, x64):
    tangents = np.random.default_rng(4).normal(size=(4, size))
    turn = 1 if (group, size) in PLANE_GROUPS else 3
    angles = np.pi - np.array([[0.0], [1e-12], [1e-6], [1e-3]])
    lengths = np.linalg.norm(tangents[:, :turn], axis=1, keepdims=True)
    tangents[:, :turn] *= angles / lengths

    @jax.jit
    @jax.vmap
    def there_and_back(tangent):
        transform = group.exp(tangent)
        log = transform.log()
        slope = jax.jacrev(rotation_log)(transform.rotation)
        return transform.matrix(), log, group.exp(log).matrix(), slope

    matrix, log, again, slope = there_and_back(jnp.asarray(tangents, dtype))
    assert np.linalg.norm(log[:, :turn], axis=1).max() <= np.pi * (1 + 1e-6)
    np.testing.assert_allclose(again, matrix, atol=atol)
    assert np.isfinite(slope).all()


@pytest.mark.parametrize("axis", range(3))
def test_logarithm_of_an_exact_half_turn(axis, x64):
    rotation = -np.eye(3)
    rotation[axis, axis] = 1
    vector, forward, reverse = _log_and_slopes(jnp.asarray(rotation))
    np.testing.assert_allclose(np.abs(vector), np.pi * np.eye(3)[axis], atol=1e-15)
    assert np.isfinite(forward).all()
    np.testing.assert_allclose(forward, reverse, atol=1e-14)


def test_no_exponential_map_beyond_space():
    for size in (5, 10):
        for group in (Rigid, Similarity, Affine):
            with pytest.raises(ValueError, match="tangent vector must have shape"):
                group.exp(jnp.zeros(size))
    with pytest.raises(ValueError, match="plane and of space"):
        Rigid.identity(dimension=4).log()
    with pytest.raises(ValueError, match="three entries in space"):
        rotation_exp(jnp.zeros(2))


@pytest.mark.parametrize("group, size", GROUPS + PLANE_GROUPS)
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
