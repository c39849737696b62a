"""The door: from what users have to a checked mesh, and its compiled form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxgeom as jg
from jaxgeom.io import load_mesh
from jaxgeom.isosurface import Capacity
from jaxgeom.meshes import point_to_mesh, sample_surface, volume
from jaxgeom.normals import WindingConsistency
from jaxgeom.pipelines import IteratedPoisson
from jaxgeom.reconstruction import ScreenedPoisson

CAPACITY = Capacity(6000, 12000, 6000)


def _bumpy(n, seed=0, dtype=np.float64):
    """An egg with axes 1, 0.8, 1.3: points and normals."""
    axes = np.array([1.0, 0.8, 1.3])
    p = np.random.default_rng(seed).normal(size=(n, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    normals = p / axes
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return (p * axes).astype(dtype), normals.astype(dtype)


def _closed(out):
    facts = out.topology
    return bool(facts.is_closed and facts.is_manifold and facts.is_oriented)


@pytest.mark.parametrize(
    "scale, shift",
    [
        pytest.param(1.0, 0.0, marks=pytest.mark.slow),
        pytest.param(1e-6, 0.0, marks=pytest.mark.slow),
        pytest.param(1e6, 3.0, marks=pytest.mark.slow),
        (2.0, 4e6),
    ],
)
def test_units_and_places_do_not_matter(scale, shift):
    points, normals = _bumpy(3000)
    out = jg.reconstruct(jg.PointCloud(points * scale + shift, normals), resolution=32)
    assert _closed(out) and int(out.topology.euler) == 2
    vertices = (np.asarray(out.mesh.vertices, np.float64) - shift) / scale
    radius = np.linalg.norm(vertices / [1.0, 0.8, 1.3], axis=1)
    np.testing.assert_allclose(radius, 1, atol=0.02)
    assert out.result == jg.RESULTS.successful


@pytest.mark.slow
@pytest.mark.parametrize(
    "orientation",
    [
        None,
        WindingConsistency(resolution=32, levels=1, steps=6),
        IteratedPoisson(WindingConsistency(resolution=16, levels=0), resolution=32),
    ],
)
def test_points_alone_are_enough(orientation):
    points, _ = _bumpy(3000)
    out = jg.reconstruct(points, resolution=32, orientation=orientation)
    assert _closed(out) and float(volume(out.mesh)) > 0
    assert any("estimated" in note for note in out.notes)


def test_attributes_arrive_at_the_vertices():
    points, normals = _bumpy(3000)
    paint = lambda x: np.cos(3 * x)
    cloud = jg.PointCloud(points, normals, attributes={"colors": paint(points)})
    out = jg.reconstruct(cloud, resolution=32)
    error = out.mesh.attributes["colors"] - paint(np.asarray(out.mesh.vertices))
    assert np.sqrt(np.mean(error**2)) < 0.03
    true = 3000 / 13.2
    np.testing.assert_allclose(
        np.median(out.mesh.attributes["density"]), true, rtol=0.2
    )


@pytest.mark.slow
def test_trim_leaves_a_hole_where_nothing_was_seen():
    points, normals = _bumpy(4400)
    seen = points[:, 2] > -0.5  # about 3000 of them: one program for many tests
    cloud = jg.PointCloud(points[seen], normals[seen])
    whole = jg.reconstruct(cloud, resolution=32)
    cut = jg.reconstruct(cloud, resolution=32, trim=0.3)
    assert _closed(whole) and not bool(cut.topology.is_closed)
    assert int(cut.topology.boundary_loops) == 1
    assert np.asarray(cut.mesh.vertices)[:, 2].min() > -0.75


@pytest.mark.slow
def test_stray_points_far_away_do_no_harm():
    points, normals = _bumpy(3000)
    stray = np.array([[2.0, 1.5, -1.6], [-1.8, 0.3, 2.2], [0.1, 1.9, 0.2]])
    cloud = jg.PointCloud(
        np.concatenate([points, stray]), np.concatenate([normals, normals[:3]])
    )
    # On so coarse a grid the specks around them are not small.
    out = jg.reconstruct(cloud, resolution=32, min_component=0.2)
    assert _closed(out) and int(out.topology.num_components) == 1
    radius = np.linalg.norm(np.asarray(out.mesh.vertices) / [1.0, 0.8, 1.3], axis=1)
    np.testing.assert_allclose(radius, 1, atol=0.04)


@pytest.mark.slow
def test_inverted_normals_are_noted():
    points, normals = _bumpy(3000)
    out = jg.reconstruct(jg.PointCloud(points, -normals), resolution=32)
    assert any("inverted" in note for note in out.notes)


def test_some_zero_normals_are_ignored_and_reported():
    points, normals = _bumpy(3000)
    normals[:20] = 0
    out = jg.reconstruct(jg.PointCloud(points, normals), resolution=32)
    assert out.result == jg.RESULTS.zero_normals and _closed(out)
    assert int(out.stats.num_ignored) == 20
    assert any("20 of 3000" in note for note in out.notes)


def test_duplicates_and_masked_nan_do_no_harm():
    points, normals = _bumpy(3000)
    points, normals = np.tile(points, (2, 1)), np.tile(normals, (2, 1))
    points[10] = np.nan
    mask = np.isfinite(points).all(axis=1)
    out = jg.reconstruct(jg.PointCloud(points, normals, mask), resolution=32)
    assert _closed(out) and out.result == jg.RESULTS.successful


LINE = np.linspace(0, 1, 50)[:, None] * np.array([1.0, 2.0, 3.0])
PLANE = np.random.default_rng(0).uniform(size=(50, 3)) * [1, 1, 0]
BAD = [
    (np.zeros((0, 3)), {}, "at least 4 points"),
    (np.eye(3), {}, "at least 4 points"),
    (np.ones((10, 3)), {}, "coincide"),
    (LINE, {}, "one line"),
    (PLANE, {}, "one plane"),
    (np.where(np.arange(30)[:, None] == 7, np.nan, 1.0) * np.ones(3), {}, "row 7"),
    (np.ones((10, 2)), {}, r"\[n, 3\]"),
    (PLANE, {"resolution": 4}, "resolution"),
    (PLANE, {"resolution": 100_000}, "memory"),
    (PLANE, {"weights": -np.ones(50)}, "nonnegative"),
]


@pytest.mark.parametrize("points, settings, words", BAD)
def test_bad_input_is_one_clear_error(points, settings, words):
    with pytest.raises(jg.GeometryError, match=words) as caught:
        jg.reconstruct(points, **settings)
    text = str(caught.value)
    assert "; given: " in text and text.endswith(".")


def test_wrong_normals_are_errors():
    points, normals = _bumpy(100)
    with pytest.raises(jg.GeometryError, match="normals must have shape"):
        jg.PointCloud(points, normals[:50])
    with pytest.raises(jg.GeometryError, match="most normals"):
        jg.reconstruct(jg.PointCloud(points, 0 * normals))
    with pytest.raises(jg.GeometryError, match="needs a cloud with normals"):
        jg.reconstruct_jit(jg.PointCloud(points), resolution=16)


def test_integer_points_are_accepted():
    points, normals = _bumpy(3000)
    cloud = jg.PointCloud(np.round(points * 1000).astype(np.int64), normals)
    assert _closed(jg.reconstruct(cloud, resolution=32))


def test_compiled_form_maps_over_ragged_clouds():
    clouds = [jg.PointCloud(*_bumpy(n, n, np.float32)) for n in (700, 1000, 850)]
    batch = jg.stack(clouds, capacity=1024)
    method = ScreenedPoisson(screening=2.0, levels=1)
    run = lambda cloud: jg.reconstruct_jit(
        cloud, resolution=24, capacity=CAPACITY, method=method
    )
    together = jax.jit(jax.vmap(run))(batch)
    single = jax.jit(run)
    for i in range(3):
        one = single(jax.tree.map(lambda x, i=i: x[i], batch))
        assert one.result == jg.RESULTS.successful
        assert int(together.mesh.num_faces[i]) == int(one.mesh.num_faces)
        np.testing.assert_allclose(
            together.mesh.vertices[i], one.mesh.vertices, atol=1e-4
        )


@pytest.mark.slow
def test_gradient_of_the_volume_is_central_difference(x64):
    points, normals = _bumpy(600)
    method = ScreenedPoisson(screening=2.0, levels=1, rtol=1e-12, max_steps=200)
    weights = np.random.default_rng(3).normal(size=(600, 3)) * 0.1

    def enclosed(t):
        cloud = jg.PointCloud(jnp.asarray(points + t * weights), normals)
        # A fixed frame: the faces must stay the same between the two differences.
        out = jg.reconstruct_jit(cloud, resolution=16, capacity=CAPACITY, method=method)
        return volume(out.mesh)

    run, slope = jax.jit(enclosed), jax.jit(jax.grad(enclosed))
    central = (run(1e-6) - run(-1e-6)) / 2e-6
    np.testing.assert_allclose(slope(0.0), central, rtol=1e-5)
    points, normals, weights = (
        x.astype(np.float32) for x in (points, normals, weights)
    )
    method = ScreenedPoisson(screening=2.0, levels=1, rtol=1e-6, max_steps=200)
    single = jax.jit(jax.grad(enclosed))(jnp.float32(0))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, central, rtol=1e-2)


def _sampled(path, num):
    """A mesh, and a cloud of so many points on it."""
    mesh = load_mesh(path)
    samples = jax.device_get(sample_surface(mesh, num, key=jax.random.key(0)))
    return mesh, jg.PointCloud(samples.points, samples.normals)


@pytest.mark.slow
def test_real_statue_of_two_hundred_points(data):
    _, cloud = _sampled(data / "meshes" / "nefertiti.ply", 200)
    out = jg.reconstruct(cloud, resolution=64)
    assert _closed(out) and int(out.topology.num_components) == 1


@pytest.mark.slow
def test_open_falcon_stays_open(data):
    mesh, cloud = _sampled(data / "meshes" / "falcon_open.ply", 20_000)
    side = float(np.ptp(cloud.points, axis=0).max())
    whole = jg.reconstruct(cloud, resolution=64)
    cut = jg.reconstruct(cloud, resolution=64, trim=0.3)
    assert _closed(whole) and not bool(cut.topology.is_closed)
    farthest = lambda m: float(point_to_mesh(m.vertices, mesh).max) / side
    # A dome over the opening, 0.25 wide, would be far from the true surface.
    cell = 1.1 / 63
    assert farthest(whole.mesh) > 3 * cell
    assert farthest(cut.mesh) < 2 * cell
