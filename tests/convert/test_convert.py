"""Round trips between representations, with what each loses measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import RESULTS, GeometryError, Grid, PointCloud, TriangleMesh, convert
from jaxgeom.fields import Sphere, Torus
from jaxgeom.isosurface import MarchingCubes
from jaxgeom.meshes import box_mesh, icosphere, volume
from jaxgeom.neighbors import closest_on_mesh
from jaxgeom.parametric import Ellipsoid, normal
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
        short = {"parametric": "surface", "grid values": "grid"}
        ends = [short.get(name, name) for name in (c.source, c.target)]
        assert c.function == "_to_".join(ends) or c.function == "vertices_to_cloud"
    kinds = {c.source for c in convert.CONVERSIONS}
    pairs = {(c.source, c.target) for c in convert.CONVERSIONS}
    assert pairs == {(a, b) for a in kinds for b in kinds if a != b}


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_parametric_surfaces_become_quads_and_samples():
    """Quads are the cells of the triangles, with a cap of triangles at each pole."""
    body = Ellipsoid(jnp.float32([1.3, 0.7, 1.1]))
    quads, mesh = (
        make(body, (12, 8))
        for make in (convert.surface_to_polygons, convert.surface_to_mesh)
    )
    assert [f.shape for f in quads.faces] == [(24, 3), (72, 4)]
    np.testing.assert_array_equal(quads.vertices, mesh.vertices)
    again = convert.polygons_to_mesh(quads)
    ordered = lambda faces: sorted(tuple(sorted(f)) for f in np.asarray(faces).tolist())
    np.testing.assert_allclose(volume(again), volume(mesh), rtol=1e-5)
    assert ordered(again.faces)[:24] == ordered(mesh.faces)[:24]
    grid = Grid(jnp.full(3, -1.5), jnp.full(3, 1.0), (4, 4, 4))
    values = convert.surface_to_grid(body, grid, (12, 8))
    np.testing.assert_allclose(
        values,
        convert.polygons_to_grid(convert.mesh_to_polygons(mesh), grid),
        atol=1e-5,
    )
    field = convert.polygons_to_field(convert.mesh_to_polygons(mesh))
    np.testing.assert_allclose(values[1, 2, 1], field(grid.nodes()[1, 2, 1]), atol=1e-5)


@pytest.mark.slow
def test_fields_samples_and_clouds_become_quads():
    """Closed, one quad for each cut edge; vertices near the surface."""
    grid = _grid(16)
    from_field = convert.field_to_polygons(_body, grid)
    values = convert.field_to_grid(_body, grid)
    from_grid = convert.grid_to_polygons(values, grid)
    (faces,) = from_field.faces
    np.testing.assert_array_equal(faces, from_grid.faces[0])
    assert faces.shape[1] == 4
    signs = np.asarray(values) < 0
    cut = sum(np.sum(np.diff(signs, axis=axis)) for axis in range(3))
    assert len(faces) == cut
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2))
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert float(jnp.abs(jax.vmap(_body)(from_field.vertices)).max()) < 0.1
    cloud = convert.polygons_to_cloud(from_grid, 2000, key=jax.random.key(4))
    assert float(jnp.abs(jax.vmap(_body)(cloud.points)).max()) < 0.1
    found = convert.cloud_to_polygons(cloud, grid)
    assert float(jnp.abs(jax.vmap(_body)(found.vertices)).max()) < 0.15
    with pytest.raises(GeometryError, match="halves of a quad"):
        convert.grid_to_polygons(values, grid, method=MarchingCubes())


def _sheet(p):
    """A field that is zero on a wavy sheet."""
    return p[2] - 0.2 * jnp.sin(2 * p[0]) * jnp.cos(1.5 * p[1])


def _off(surface):
    """How far places of a surface are from the sheet, and the height of its normal."""
    uv = jnp.stack(jnp.meshgrid(*[jnp.linspace(0.03, 0.97, 9)] * 2), -1).reshape(-1, 2)
    normals = jax.vmap(lambda x: normal(surface, x))(uv)
    return float(jnp.abs(jax.vmap(_sheet)(jax.vmap(surface)(uv))).max()), normals[:, 2]


@pytest.mark.slow
def test_sheets_become_nurbs():
    """From a field, samples, a mesh, polygons and points; the side is kept."""
    grid = Grid(jnp.float32([-1, -1.2, -1]), jnp.full(3, 2 / 23), (24, 28, 24))
    mesh = convert.field_to_mesh(_sheet, grid).mesh
    values = convert.field_to_grid(_sheet, grid)
    points = np.random.default_rng(0).uniform(-1, 1, (3000, 2)).astype(np.float32)
    heights = 0.2 * np.sin(2 * points[:, 0]) * np.cos(1.5 * points[:, 1])
    up = np.broadcast_to(np.float32([0, 0, 1]), (3000, 3))
    cloud = PointCloud(np.c_[points, heights], up)
    found = {
        "field": convert.field_to_surface(_sheet, grid),
        "grid": convert.grid_to_surface(values, grid),
        "mesh": convert.mesh_to_surface(mesh),
        "polygons": convert.polygons_to_surface(convert.mesh_to_polygons(mesh)),
        "cloud": convert.cloud_to_surface(cloud, (8, 8)),
    }
    for name, fit in found.items():
        off, heights = _off(fit.shape)
        assert fit.result == RESULTS.successful and float(fit.rmse) < 3e-3, name
        assert off < 5e-3 and heights.min() > 0.5, name
    below = convert.cloud_to_surface(PointCloud(cloud.points, -up), (8, 8))
    assert _off(below.shape)[1].max() < -0.5
    padded = jax.tree.map(lambda x: jnp.concatenate([x, x[:9] * 50]), cloud)
    padded = PointCloud(padded.points, padded.normals, jnp.arange(3009) < 3000)
    again = jax.jit(lambda c: convert.cloud_to_surface(c, (8, 8)))(padded)
    np.testing.assert_allclose(
        again.shape.control, found["cloud"].shape.control, atol=2e-3
    )
    with pytest.raises(GeometryError, match="must be a disc"):
        convert.mesh_to_surface(icosphere(1))
