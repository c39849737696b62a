"""Round trips between representations, with what each loses measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import GeometryError, Grid, PointCloud, TriangleMesh, convert
from jaxgeom.fields import Sphere, Torus
from jaxgeom.meshes import box_mesh, icosphere, volume
from jaxgeom.neighbors import closest_on_mesh
from jaxgeom.parametric import Ellipsoid
from jaxgeom.shapes import PolygonMesh

CENTER, SIDES = np.asarray([3.0, -1.0, 2.0]), np.asarray([1.3, 0.7, 1.1])


def _ellipsoid():
    """A mesh with a position attribute, and its volume."""
    ball = icosphere(3)
    v = jnp.asarray(ball.vertices * SIDES + CENTER, jnp.float32)
    return TriangleMesh(v, ball.faces, attributes={"place": v})


def _grid(n):
    """A grid around the ellipsoid, unlike along its axes."""
    low, extent = CENTER - 1.25 * SIDES, 2.5 * SIDES
    shape = (n, n + 3, n + 6)
    spacing = extent / (np.asarray(shape) - 1)
    return Grid(jnp.asarray(low, jnp.float32), jnp.asarray(spacing, jnp.float32), shape)


def _body(p):
    """A field whose zero surface is the ellipsoid; not a distance."""
    return jnp.sum(((p - CENTER) / SIDES) ** 2) - 1


def test_the_table_names_every_function_once():
    functions = [c.function for c in convert.CONVERSIONS]
    public = {n for n in dir(convert) if "_to_" in n and not n.startswith("_")}
    assert sorted(functions) == sorted(public)
    text = convert.table()
    assert text.count("\n") == 2 + len(functions)
    for c in convert.CONVERSIONS:
        assert callable(getattr(convert, c.function))
        assert f"| `{c.function}` | {c.source} | {c.target} |" in text
        assert c.function.split("_to_")[1].split("_")[0] in c.target


@pytest.mark.slow
def test_mesh_to_grid_and_back():
    mesh, grid = _ellipsoid(), _grid(24)
    values = jax.jit(convert.mesh_to_grid)(mesh, grid)
    again = convert.grid_to_mesh(values, grid).mesh
    np.testing.assert_allclose(volume(again), volume(mesh), rtol=0.01)
    away = closest_on_mesh(mesh, again.vertices).distances
    assert float(away.max()) < 0.1 * float(grid.spacing.max())
    node = (5, 7, 3)
    field = convert.mesh_to_field(mesh)
    at = float(field(grid.nodes()[node]))
    np.testing.assert_allclose(values[node], at, rtol=1e-4, atol=1e-6)


def test_field_and_grid_agree_at_the_nodes():
    grid = _grid(12)
    values = convert.field_to_grid(_body, grid)
    back = convert.grid_to_field(values, grid)
    nodes = grid.nodes()[::3, ::4, ::5].reshape(-1, 3)
    np.testing.assert_allclose(
        jax.vmap(back)(nodes), jax.vmap(_body)(nodes), rtol=1e-5, atol=2e-5
    )
    again = convert.field_to_grid(back, grid)
    np.testing.assert_allclose(again, values, atol=2e-5)


@pytest.mark.slow
def test_field_to_cloud_lies_on_the_surface():
    cloud = convert.field_to_cloud(_body, _grid(24), 200, key=jax.random.key(0))
    assert int(cloud.num_points) == 200
    np.testing.assert_allclose(jax.vmap(_body)(cloud.points), 0, atol=2e-5)
    normals = (np.asarray(cloud.points) - CENTER) / SIDES**2
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.testing.assert_allclose(cloud.normals, normals, atol=1e-4)


def test_mesh_to_cloud_lies_on_the_mesh():
    mesh = _ellipsoid()
    cloud = jax.jit(convert.mesh_to_cloud, static_argnums=1)(
        mesh, 200, key=jax.random.key(1)
    )
    assert float(closest_on_mesh(mesh, cloud.points).distances.max()) < 1e-5
    np.testing.assert_allclose(cloud.attributes["place"], cloud.points, atol=1e-5)
    bare = convert.vertices_to_cloud(mesh)
    np.testing.assert_array_equal(bare.points, mesh.vertices)
    outward = (np.asarray(bare.points) - CENTER) / SIDES**2
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert np.sum(bare.normals * outward, axis=1).min() > 0.99


@pytest.mark.slow
def test_cloud_to_field_and_mesh():
    grid = _grid(24)
    cloud = convert.field_to_cloud(_body, grid, 2000, key=jax.random.key(2))
    out = convert.cloud_to_mesh(cloud, grid)
    away = jax.vmap(_body)(out.mesh.vertices) / 2  # about the distance over SIDES
    assert float(jnp.abs(away).max()) < 0.05 and float(volume(out.mesh)) > 0
    true = 4 / 3 * np.pi * SIDES.prod()
    np.testing.assert_allclose(volume(out.mesh), true, rtol=0.02)
    values = convert.cloud_to_grid(cloud, grid)
    assert (
        values.shape == grid.shape and float(values[12, 13, 15]) < 0 < values[0, 0, 0]
    )
    again = convert.grid_to_cloud(values, grid, 100, key=jax.random.key(3))
    assert float(jnp.abs(jax.vmap(_body)(again.points)).max()) < 0.1
    with pytest.raises(GeometryError, match="cloud with normals"):
        convert.cloud_to_field(PointCloud(cloud.points), grid)


def test_field_to_mesh_of_exact_distances():
    n = 32
    body = Torus(0.9, 0.35) | Sphere(0.4)
    spacing = jnp.full(3, 2.8 / (n - 1))
    grid = Grid(jnp.full(3, -1.4), spacing, (n, n, n))
    mesh = convert.field_to_mesh(body, grid).mesh
    error = float(jnp.abs(jax.vmap(body)(mesh.vertices)).max())
    # Linear interpolation of a distance of curvature 1 / r: at most h^2 / (8 r) or so.
    assert error < float(spacing[0]) ** 2 / 0.35


def test_polygons_and_triangles():
    mesh = _ellipsoid()
    there = convert.mesh_to_polygons(mesh)
    back = convert.polygons_to_mesh(there)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.attributes["place"], mesh.attributes["place"])
    corners = box_mesh((1.0, 2.0, 3.0))
    quads = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1)])
    quads = np.concatenate([quads, [(2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]])
    box = convert.polygons_to_mesh(PolygonMesh(corners.vertices, quads))
    np.testing.assert_allclose(volume(box), 6, rtol=1e-6)
    assert box.faces.shape == (12, 3)


def test_parametric_surfaces_become_meshes_clouds_and_fields():
    """The mesh is closed and inside, nearer by 4 with cells half as wide."""
    body = Ellipsoid(jnp.float32([1.3, 0.7, 1.1]))
    true, gaps = 4 / 3 * np.pi * 1.3 * 0.7 * 1.1, []
    for n in (12, 24):
        mesh = convert.surface_to_mesh(body, (2 * n, n))
        gaps.append(float(true - volume(mesh)))
    assert 3.6 < gaps[0] / gaps[1] < 4.4 and gaps[1] > 0
    cloud = convert.surface_to_cloud(body, (48, 24))
    level = jnp.sum((cloud.points / jnp.float32([1.3, 0.7, 1.1])) ** 2, axis=1)
    np.testing.assert_allclose(level, 1, atol=1e-5)
    field = convert.surface_to_field(body, (48, 24))
    assert abs(float(field(jnp.float32([0, 0, 2.0]))) - 0.9) < 5e-3
    assert float(field(jnp.float32([0.1, 0.2, 0.1]))) < 0
