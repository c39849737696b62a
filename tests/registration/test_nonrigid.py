"""Non-rigid registration: recovery of a known warp, landmarks, laws of the energies."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom._core import RESULTS
from jaxgeom.meshes import icosphere, vertex_normals
from jaxgeom.registration import (
    AsRigidAsPossible,
    EmbeddedGraph,
    Landmarks,
    PerVertexAffine,
    StiffnessSchedule,
    nonrigid,
)
from jaxgeom.registration._matching import Matches, across
from jaxgeom.registration._nonrigid import landmark_rows
from jaxgeom.shapes import PointCloud, TriangleMesh
from jaxgeom.transforms import rotation_exp

MODELS = {
    "rigid parts": AsRigidAsPossible(),
    "affine": PerVertexAffine(reach=0.12),
    "graph": EmbeddedGraph(nodes=60),
}
PADDING = 7
CENTER = np.array([3.0, 1.0, -2.0])


def template(dtype=np.float32, subdivisions=3):
    """A bumpy body, with padding behind its vertices and faces."""
    ball = icosphere(subdivisions)
    u, v = np.asarray(ball.vertices), ball.vertices.shape[0]
    bumps = 1 + 0.35 * np.sin(5.1 * u[:, :1] + 0.3) * np.cos(4.3 * u[:, 1:2] + 0.4)
    points = np.pad(u * bumps * [1.6, 0.9, 0.6] + CENTER, ((0, PADDING), (0, 0)))
    faces = np.asarray(ball.faces)
    faces = np.append(faces, np.full((9, 3), v + PADDING), axis=0)
    return TriangleMesh(
        jnp.asarray(points, dtype),
        jnp.asarray(faces),
        attributes={"label": jnp.arange(v + PADDING)},
        num_vertices=jnp.int32(v),
        num_faces=jnp.int32(len(faces) - 9),
    )


def warp(points):
    """A bend about the y axis, and a shear that grows."""
    x, y, z = (np.asarray(points, float) - CENTER).T
    bend = 0.3
    radius = 1 / bend - z
    bent = [
        radius * np.sin(bend * x),
        y + 0.06 * x**2,
        1 / bend - radius * np.cos(bend * x),
    ]
    return np.stack(bent, 1) + CENTER


def truth(subdivisions=3):
    mesh = template(subdivisions=subdivisions)
    points = jnp.asarray(warp(mesh.vertices), jnp.float32)
    return eqx.tree_at(lambda m: m.vertices, mesh, points)


def target_of(name):
    """A mesh, a cloud with normals, a cloud without: finer than the template."""
    mesh = truth(4)
    normals = vertex_normals(mesh) if name == "affine" else None
    if name == "rigid parts":
        return mesh
    return PointCloud(mesh.vertices, normals, mesh.vertex_mask)


def marks(weight):
    rows = jnp.arange(5, 640, 90)
    return Landmarks(rows, truth().vertices[rows], jnp.float32(weight))


@functools.cache
def program(name):
    schedule = StiffnessSchedule(end=0.002, stages=7)
    return jax.jit(
        lambda mesh, target, landmarks, rtol: nonrigid(
            mesh,
            target,
            model=MODELS[name],
            landmarks=landmarks,
            schedule=schedule,
            rtol=rtol,
        )
    )


def rms(x):
    return float(jnp.sqrt(jnp.mean(jnp.sum(x**2, axis=-1))))


@pytest.mark.parametrize("name", MODELS)
def test_a_known_warp_is_recovered(name):
    mesh, want, real = template(), truth(), slice(0, 642)
    moved = rms((mesh.vertices - want.vertices)[real])
    run, target = program(name), target_of(name)
    left = {}
    for weight in (0.0, 10.0):
        out = run(mesh, target, marks(weight), jnp.float32(1e-3))
        error = (out.mesh.vertices - want.vertices)[real]
        left[weight] = rms(error)
        rows = marks(weight).vertices
        left_at_marks = rms(error[rows])
        spacing = 0.02 if name == "rigid parts" else 0.12
        assert out.fitness > 0.95 and out.rmse < spacing * moved
        # Nothing but the vertices changes, and the padding not at all.
        kept = lambda m: (m.faces, m.attributes, m.num_vertices, m.vertices[642:])
        assert eqx.tree_equal(kept(out.mesh), kept(mesh))
    assert left[0.0] < 0.35 * moved and left[10.0] < 0.2 * moved
    assert left_at_marks < 0.01 * moved


def test_statuses():
    mesh, few = template(), jnp.float32(1e-3)
    run, cloud = program("graph"), target_of("graph")
    nothing = eqx.tree_at(lambda c: c.mask, cloud, jnp.zeros_like(cloud.mask))
    assert bool(run(mesh, cloud, marks(1), few).result == RESULTS.successful)
    lost = run(mesh, nothing, marks(0), few)
    assert bool(lost.result == RESULTS.too_few_points) and lost.fitness == 0
    assert jnp.isfinite(lost.mesh.vertices).all()
    hurried = run(mesh, cloud, marks(1), jnp.float32(0))
    assert bool(hurried.result == RESULTS.not_converged)
    surface = target_of("rigid parts")
    none = eqx.tree_at(lambda m: m.num_faces, surface, jnp.int32(0))
    empty = program("rigid parts")(mesh, none, marks(0), few)
    assert bool(empty.result == RESULTS.no_surface)


def _energy(model, prepared, frames):
    return sum(jnp.sum(row**2) for row in model.strain(prepared, frames))


@pytest.mark.parametrize("name", MODELS)
def test_rigid_motions_cost_nothing(x64, name):
    model, mesh = MODELS[name], template(float)

    @jax.jit
    def energies(mesh):
        prepared = model.prepare(mesh)
        rest = prepared.rest
        turn = rotation_exp(jnp.asarray([0.7, -1.9, 0.4]))
        places = rest.points @ turn.T + jnp.asarray([3.0, 0.2, -1])
        moved = eqx.tree_at(
            lambda f: (f.points, f.linear), rest, (places, turn @ rest.linear)
        )
        way = jax.random.normal(jax.random.key(0), (len(places), model.freedoms))
        bent = model.move(prepared, moved, 0.01 * way)
        still = model.vertices(prepared, moved) - (
            mesh.vertices @ turn.T + jnp.asarray([3.0, 0.2, -1])
        )
        return *(_energy(model, prepared, f) for f in (moved, bent)), still

    rigid, bent, still = energies(mesh)
    assert rigid < 1e-24 < 1e-6 < bent
    np.testing.assert_allclose(still, 0, atol=1e-12)


def _central(function, at, way, h=1e-5):
    """The derivative along a way, exact and by central differences."""
    step = lambda t: function(at + t * way)
    return jax.grad(step)(0.0), (step(h) - step(-h)) / (2 * h)


@pytest.mark.parametrize("name", MODELS)
def test_gradients_of_the_strain(x64, name):
    model, mesh = MODELS[name], template(float)

    @jax.jit
    def both(mesh):
        prepared = model.prepare(mesh)
        shape = (len(prepared.rest.points), model.freedoms)
        one, two = (
            jax.random.normal(k, shape) for k in jax.random.split(jax.random.key(1))
        )
        energy = lambda t: _energy(
            model, prepared, model.move(prepared, prepared.rest, t)
        )
        return _central(energy, 0.03 * one, two)

    np.testing.assert_allclose(*both(mesh), rtol=1e-6)


def test_gradients_of_data_and_landmarks(x64):
    keys = jax.random.split(jax.random.key(2), 4)
    points, there, toward, way = (jax.random.normal(k, (30, 3)) for k in keys)
    toward = toward / jnp.linalg.norm(toward, axis=1, keepdims=True)
    matches = Matches(there, toward.at[:5].set(0), jnp.ones(30, bool))
    landmarks = Landmarks(jnp.asarray([3, 9, 4]), there[:3], 2.5)

    @jax.jit
    def both():
        data = lambda p: jnp.sum(across(p, matches, 0.3) ** 2)
        held = lambda p: jnp.sum(landmark_rows(landmarks, p) ** 2)
        return _central(data, points, way), _central(held, points, way)

    for exact, numeric in both():
        np.testing.assert_allclose(exact, numeric, rtol=1e-8)
    gap = points - there
    plain = jnp.sum(jnp.sum(toward * gap, axis=1)[5:] ** 2) + jnp.sum(gap[:5] ** 2)
    plane = Matches(matches.points, matches.normals, matches.mask)
    np.testing.assert_allclose(jnp.sum(across(points, plane, 0.0) ** 2), plain)


class _Redescending(eqx.Module):
    """Tukey's weight with a fixed width."""

    size: float = 0.1

    def width(self, squares, mask, previous):
        return jnp.full((), self.size, squares.dtype)

    def weight(self, s):
        return jnp.maximum(1 - s, 0) ** 2


@pytest.mark.slow
def test_a_robust_kernel_ignores_clutter():
    mesh, want = template(), truth()
    normals = vertex_normals(want)
    lifted = jnp.where(jnp.arange(len(normals))[:, None] % 9 == 0, 0.4 * normals, 0)
    cloud = PointCloud(want.vertices + lifted, None, want.vertex_mask)
    start = eqx.tree_at(
        lambda m: m.vertices, mesh, (mesh.vertices + 3 * want.vertices) / 4
    )
    left = []
    for kernel in (None, _Redescending()):
        out = jax.jit(lambda a, b, k=kernel: nonrigid(a, b, kernel=k))(start, cloud)
        left.append(rms((out.mesh.vertices - want.vertices)[:642]))
    assert left[1] < 0.8 * left[0]
