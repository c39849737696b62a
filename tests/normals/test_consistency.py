"""Normals from bare points by convolutions, against the sums over all pairs."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from scipy.special import erf

from jaxgeom.normals import LocalPlanes, WindingConsistency
from jaxgeom.normals._winding_grid import GridWinding
from jaxgeom.shapes import PointCloud

# A torus of unequal widths, off the origin: 600 points in a cloud of 700.
N, CAPACITY = 600, 700
METHOD = WindingConsistency(resolution=32, levels=1, steps=6, k=None)


@eqx.filter_jit
def _measured(cloud):
    return METHOD.measured(cloud)


def _torus(seed, stretch=1.3, padding=np.nan):
    mesh = trimesh.creation.torus(1.5, 0.6)
    mesh.apply_transform(np.diag([stretch, 1.0, 0.9, 1.0]))
    mesh.apply_translation([3, -2, 1])
    points, faces = trimesh.sample.sample_surface(mesh, N, seed=seed)
    rest = np.full((CAPACITY - N, 3), padding)
    points = np.concatenate([points, rest]).astype(np.float32)
    return PointCloud(points, mask=np.arange(CAPACITY) < N), mesh.face_normals[faces]


def _pairs(points, dipoles, width):
    """The winding number at all points by the sum over pairs, in double precision."""
    r = points[:, None] - points
    t = np.linalg.norm(r, axis=-1) / width + np.eye(len(r))
    smeared = erf(t / 2**0.5) - (2 / np.pi) ** 0.5 * t * np.exp(-(t**2) / 2)
    weight = smeared / (4 * np.pi * (t * width) ** 3)
    return -np.einsum("ijd,jd,ij->i", r, dipoles, weight)


def test_grid_sums_converge_to_the_sums_over_pairs():
    rng = np.random.default_rng(0)
    points = rng.random((60, 3))
    dipoles = rng.normal(size=(60, 3))
    errors = []
    for size in (18, 40):
        spacings = size - 7.0
        width = jnp.asarray(0.15 * spacings, jnp.float32)
        real = jnp.ones(60)
        grid = GridWinding.of(jnp.float32(points), real, size, width)
        ours = grid.at_points(grid.field(jnp.float32(dipoles)))
        truth = _pairs(points * spacings, dipoles, 0.15 * spacings)
        errors.append(np.abs(ours - truth).max() / np.abs(truth).max())
    # The order of trilinear weights is 2: (33 / 11)^2 = 9.
    assert errors[1] < 0.02
    assert errors[0] / errors[1] > 6.5
    values = jnp.float32(rng.normal(size=60))
    there = jnp.vdot(values, ours)
    back = jnp.vdot(grid.adjoint(values), jnp.float32(dipoles))
    np.testing.assert_allclose(there, back, rtol=1e-4)


def test_outward_sure_and_blind_to_padding():
    cloud, truth = _torus(0)
    out = _measured(cloud)
    normals, sure = np.asarray(out.cloud.normals), np.asarray(out.confidence)
    np.testing.assert_allclose(np.linalg.norm(normals[:N], axis=1), 1, rtol=1e-5)
    cosine = np.sum(normals[:N] * truth, axis=1)
    assert (cosine > 0).mean() >= 0.995
    assert cosine.mean() > 0.93
    assert np.median(sure[:N]) > 0.6
    assert (normals[N:] == 0).all()
    assert (sure[N:] == 0).all()
    elsewhere, _ = _torus(0, padding=40.0)
    again = _measured(elsewhere)
    np.testing.assert_array_equal(again.cloud.normals, normals)
    np.testing.assert_array_equal(again.confidence, sure)


@pytest.mark.slow
def test_vmap_is_a_loop():
    clouds = [_torus(seed, stretch)[0] for seed, stretch in ((0, 1.3), (1, 0.8))]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *clouds)
    many = eqx.filter_jit(eqx.filter_vmap(METHOD.measured))(stacked)
    for i, cloud in enumerate(clouds):
        one = _measured(cloud)
        np.testing.assert_allclose(many.cloud.normals[i], one.cloud.normals, atol=2e-3)
        np.testing.assert_allclose(many.confidence[i], one.confidence, atol=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("k", [None, 12])
def test_planes_keep_the_side_of_the_field(k):
    cloud, truth = _torus(2)
    method = WindingConsistency(resolution=32, levels=1, steps=6, k=k)
    ours = eqx.filter_jit(method)(cloud).normals[:N]
    planes = eqx.filter_jit(LocalPlanes())(cloud).normals[:N]
    assert (np.sum(ours * truth, axis=1) > 0).mean() >= 0.99
    assert (np.sum(ours * planes, axis=1) > 0).mean() >= 0.98
