"""Areas, normals, volume, centroid, interpolation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom.meshes import (
    AngleWeights,
    AreaWeights,
    UniformWeights,
    area,
    box_mesh,
    centroid,
    face_areas,
    face_normals,
    icosphere,
    interpolate,
    torus_mesh,
    vertex_normals,
    volume,
)
from jaxgeom.shapes import TriangleMesh

from .shapes_for_tests import (
    bent,
    central_difference,
    closed_meshes,
    padded,
    peer,
    stacked,
    with_faces,
)

NAMES = ["sphere", "box", "torus"]
SCALARS = {
    "area": area,
    "volume": volume,
    "centroid": lambda m: centroid(m) @ jnp.array([0.3, -0.8, 1.1]),
}
WEIGHTS = [AreaWeights(), AngleWeights(), UniformWeights()]


@pytest.mark.parametrize("name", NAMES)
def test_agrees_with_trimesh(x64, name):
    mesh = closed_meshes()[name]
    other = peer(mesh)
    assert area(mesh) == pytest.approx(other.area, rel=1e-12)
    assert volume(mesh) == pytest.approx(other.volume, rel=1e-12)
    np.testing.assert_allclose(centroid(mesh), other.centroid, atol=1e-12)
    np.testing.assert_allclose(face_areas(mesh), other.area_faces, atol=1e-12)
    np.testing.assert_allclose(face_normals(mesh), other.face_normals, atol=1e-9)
    # The vertex normals of trimesh are weighted by angle.
    angle = vertex_normals(mesh, weights=AngleWeights())
    np.testing.assert_allclose(angle, other.vertex_normals, atol=1e-9)


def test_generators_converge_at_second_order(x64):
    truths = [
        (lambda n: icosphere(n, radius=1.3), 4 / 3 * np.pi * 1.3**3),
        (
            lambda n: torus_mesh(1.5, 0.4, around=8 * 2**n, across=6 * 2**n),
            2 * np.pi**2 * 1.5 * 0.4**2,
        ),
    ]
    for make, truth in truths:
        errors = [truth - float(volume(make(n))) for n in (2, 3)]
        assert errors[1] > 0
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.05)


def test_box_is_exact(x64):
    mesh = box_mesh((0.7, 2.1, 1.3), subdivisions=2)
    assert mesh.faces.shape == (12 * 16, 3)
    assert volume(mesh) == pytest.approx(0.7 * 2.1 * 1.3)
    assert area(mesh) == pytest.approx(2 * (0.7 * 2.1 + 2.1 * 1.3 + 1.3 * 0.7))


def test_angle_weights_do_not_see_the_triangulation(x64):
    corner = lambda mesh: vertex_normals(mesh, weights=AngleWeights())[0]
    expected = -np.ones(3) / np.sqrt(3)
    np.testing.assert_allclose(corner(box_mesh((0.7, 2.1, 1.3))), expected, atol=1e-12)
    skewed = vertex_normals(box_mesh((0.7, 2.1, 1.3)), weights=AreaWeights())[0]
    assert not np.allclose(skewed, expected, atol=1e-3)


def test_volume_keeps_its_digits_far_from_the_origin():
    mesh = icosphere(2, radius=1.3)
    far = TriangleMesh(mesh.vertices + jnp.float32(1000.0), mesh.faces)
    true = peer(far).volume
    assert volume(far) == pytest.approx(true, rel=1e-5)
    flipped = with_faces(mesh, mesh.faces[:, ::-1])
    assert volume(flipped) == pytest.approx(-float(volume(mesh)), rel=1e-6)


@pytest.mark.parametrize("quantity", SCALARS)
def test_gradients_are_central_differences(x64, quantity):
    mesh = closed_meshes()["torus"]
    # An open mesh, so that the volume depends on its reference point.
    faces = mesh.faces[:-20]
    function = lambda x: SCALARS[quantity](TriangleMesh(x, faces))
    _check_gradient(function, mesh.vertices)


@pytest.mark.parametrize("weights", WEIGHTS, ids=lambda w: type(w).__name__)
def test_normal_gradients_are_central_differences(x64, weights):
    mesh = bent(icosphere(1, radius=1.4))
    probe = jax.random.normal(jax.random.key(3), mesh.vertices.shape)
    make = lambda x: TriangleMesh(x, mesh.faces)
    _check_gradient(
        lambda x: jnp.sum(probe * vertex_normals(make(x), weights=weights)),
        mesh.vertices,
    )


def test_face_normal_gradients_are_central_differences(x64):
    mesh = bent(icosphere(1, radius=1.4))
    probe = jax.random.normal(jax.random.key(4), mesh.faces.shape)
    _check_gradient(
        lambda x: jnp.sum(probe * face_normals(TriangleMesh(x, mesh.faces))),
        mesh.vertices,
    )


def _check_gradient(function, x):
    direction = jax.random.normal(jax.random.key(1), x.shape)
    numeric = central_difference(function, x, direction)
    reverse = jnp.vdot(jax.jit(jax.grad(function))(x), direction)
    forward = jax.jvp(function, (x,), (direction,))[1]
    assert reverse == pytest.approx(float(numeric), rel=1e-7, abs=1e-8)
    assert forward == pytest.approx(float(numeric), rel=1e-7, abs=1e-8)


@pytest.mark.parametrize("weights", WEIGHTS, ids=lambda w: type(w).__name__)
def test_degenerate_faces_have_finite_gradients(weights):
    vertices = jnp.array([[0.2, 0.1, 0], [1.3, 0, 0], [2.4, -0.1, 0], [0.2, 0.1, 0]])
    faces = jnp.array([[0, 1, 2], [0, 0, 1], [0, 3, 1], [1, 1, 1]], jnp.int32)

    def total(x):
        mesh = TriangleMesh(x, faces)
        normals = vertex_normals(mesh, weights=weights)
        return jnp.sum(normals) + area(mesh) + volume(mesh) + jnp.sum(centroid(mesh))

    assert jnp.all(jnp.isfinite(jax.grad(total)(vertices)))
    assert jnp.all(jnp.isfinite(vertex_normals(TriangleMesh(vertices, faces))))


@pytest.mark.parametrize("weights", WEIGHTS, ids=lambda w: type(w).__name__)
def test_padding_changes_nothing(weights):
    mesh = closed_meshes()["box"]
    more = padded(mesh)
    v, f = mesh.vertices.shape[0], mesh.faces.shape[0]

    def everything(vertices, like):
        counts = {"num_vertices": like.num_vertices, "num_faces": like.num_faces}
        m = TriangleMesh(vertices, like.faces, **counts)
        normals = vertex_normals(m, weights=weights)
        return normals, face_normals(m), face_areas(m), area(m), volume(m), centroid(m)

    total = lambda x, like: sum(jnp.sum(y * y) for y in everything(x, like))
    plain = everything(mesh.vertices, mesh)
    with_padding = everything(more.vertices, more)
    for a, b in zip(plain, with_padding, strict=True):
        cut = b[: a.shape[0]] if a.ndim else b
        np.testing.assert_allclose(a, cut, rtol=1e-5, atol=1e-6)
    assert jnp.all(with_padding[0][v:] == 0)
    assert jnp.all(with_padding[1][f:] == 0)
    gradient = jax.grad(total)(more.vertices, more)
    assert jnp.all(gradient[v:] == 0)
    expected = jax.grad(total)(mesh.vertices, mesh)
    np.testing.assert_allclose(gradient[:v], expected, rtol=1e-4, atol=1e-4)


def test_vmap_is_loop():
    one = padded(closed_meshes()["sphere"], 10, 12)
    other = TriangleMesh(one.vertices * 0.7, one.faces[::1], num_faces=jnp.int32(31))
    other = TriangleMesh(
        *(other.vertices, other.faces),
        num_vertices=one.num_vertices,
        num_faces=jnp.int32(31),
    )
    other = TriangleMesh(
        other.vertices,
        jnp.where(other.face_mask[:, None], other.faces, other.vertices.shape[0]),
        num_vertices=one.num_vertices,
        num_faces=other.num_faces,
    )
    function = lambda m: (vertex_normals(m), area(m), volume(m), centroid(m))
    batched = jax.jit(jax.vmap(function))(stacked(one, other))
    for i, mesh in enumerate((one, other)):
        for a, b in zip(batched, function(mesh), strict=True):
            np.testing.assert_allclose(a[i], b, rtol=1e-5, atol=1e-6)


def test_interpolation_reproduces_linear_functions(x64):
    mesh = padded(closed_meshes()["torus"])
    slope = jnp.array([[0.3, -0.8], [1.1, 0.2], [0.5, 0.9]])
    face = jnp.array([0, 5, 17, 5])
    weights = jax.random.dirichlet(jax.random.key(0), jnp.ones(3), (4,))
    points = interpolate(mesh, mesh.vertices, face, weights)
    values = interpolate(mesh, mesh.vertices @ slope + 2, face, weights)
    np.testing.assert_allclose(values, points @ slope + 2, atol=1e-12)
    one = interpolate(mesh, mesh.vertices[:, 0], face, weights)
    np.testing.assert_allclose(one, points[:, 0], atol=1e-12)
    outside = jnp.array([mesh.faces.shape[0], mesh.faces.shape[0] - 1])
    assert jnp.all(interpolate(mesh, mesh.vertices, outside, weights[:2]) == 0)


def test_wrong_shapes_are_told():
    mesh = icosphere(0)
    with pytest.raises(ValueError, match="attribute must have shape"):
        interpolate(mesh, jnp.ones(5), jnp.array([0]), jnp.ones((1, 3)))
    with pytest.raises(ValueError, match="subdivisions must be at least 0"):
        icosphere(-1)
    with pytest.raises(ValueError, match="around must be at least 3"):
        torus_mesh(around=2)


def test_single_precision_stays_single():
    mesh = closed_meshes()["box"]
    for value in (area(mesh), volume(mesh), centroid(mesh), vertex_normals(mesh)):
        assert value.dtype == jnp.float32
