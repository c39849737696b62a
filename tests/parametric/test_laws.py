"""What holds for every surface: normals, forms, curvatures, meshes, precisions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import parametric as jp

from .members import counted, in_dtype, parameters, surfaces

RESOLUTION = (10, 8)
LONG = {"tube", "offset", "nurbs", "nurbs sphere", "nurbs torus"}
CASES = [
    pytest.param(n, marks=pytest.mark.slow if n in LONG else ()) for n in surfaces()
]


@jax.jit
def all_about(surface, uv):
    """Points and derivatives at uv [n, 2], the mesh, area and volume."""

    def at(x):
        return {
            "point": surface(x),
            "tangents": jp.tangents(surface, x),
            "normal": jp.normal(surface, x),
            "first": jp.first_form(surface, x),
            "second": jp.second_form(surface, x),
            "bend": jp.curvatures(surface, x),
        }

    step = 1e-5 * jnp.eye(2)
    ahead = jax.vmap(lambda x: jax.vmap(lambda d: surface(x + d))(step))(uv)
    behind = jax.vmap(lambda x: jax.vmap(lambda d: surface(x - d))(step))(uv)
    return {
        **jax.vmap(at)(uv),
        "differences": (ahead - behind) / 2e-5,
        "single": surface(uv[0]),
        "mesh": jp.tessellate(surface, RESOLUTION),
        "area": jp.area(surface, cells=(4, 4)),
        "volume": jp.enclosed_volume(surface, cells=(4, 4)),
    }


@pytest.mark.parametrize("name", CASES)
def test_every_surface(name, x64):
    surface, known = surfaces()[name]
    surface = in_dtype(surface, jnp.float64)
    found = jax.tree.map(np.asarray, all_about(surface, parameters(surface, 5)))
    check_differential_geometry(found)
    check_mesh(found["mesh"], known)
    if known.area is not None:
        np.testing.assert_allclose(found["area"], known.area, rtol=2e-9)
    if known.volume is not None:
        np.testing.assert_allclose(found["volume"], known.volume, rtol=1e-9)


def check_differential_geometry(found):
    tangents, normal = found["tangents"], found["normal"]
    close = np.testing.assert_allclose
    close(found["single"], found["point"][0], atol=1e-15)
    close(tangents, found["differences"], atol=2e-8)
    close(np.linalg.norm(normal, axis=1), 1, rtol=1e-13)
    close(np.einsum("nid,nd->ni", tangents, normal), 0, atol=1e-13)
    first, second, bend = found["first"], found["second"], found["bend"]
    close(first, np.einsum("nid,njd->nij", tangents, tangents), atol=1e-13)
    close(second, second.swapaxes(1, 2), atol=1e-12)
    shape = np.linalg.solve(first, second)
    close(np.trace(shape, axis1=1, axis2=2), 2 * bend.mean, atol=1e-9)
    close(np.linalg.det(shape), bend.gaussian, atol=1e-9)
    close(bend.principal.sum(1), 2 * bend.mean, atol=1e-10)
    close(bend.principal.prod(1), bend.gaussian, atol=1e-9)


def check_mesh(mesh, known):
    count = counted(mesh.faces)
    assert count.manifold and count.closed == known.closed
    assert (count.euler, count.oriented) == (known.euler, known.oriented)
    if not known.oriented:
        assert mesh.normals is None
        return
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    assert (np.linalg.norm(across, axis=1) > 0).all()
    # At an apex the normal is that of one meridian only.
    smooth = np.linalg.norm(mesh.normals, axis=1)[mesh.faces] > 0
    facing = np.sum(across[:, None] * mesh.normals[mesh.faces], axis=-1)
    assert np.mean(facing[smooth] > 0) > 0.9
    assert (facing.max(axis=1) > 0).all()


@pytest.mark.parametrize("name", ["ellipsoid", "cone", "nurbs"])
def test_single_precision(name):
    surface = in_dtype(surfaces()[name][0], jnp.float32)
    uv = parameters(surface, 3).astype(jnp.float32)
    at = lambda x: (surface(x), jp.normal(surface, x), jp.curvatures(surface, x))
    found = jax.jit(jax.vmap(at))(uv)
    with jax.enable_x64(True):
        double = in_dtype(surface, jnp.float64)
        at = lambda x: (double(x), jp.normal(double, x), jp.curvatures(double, x))
        expected = jax.jit(jax.vmap(at))(uv.astype(jnp.float64))
    pairs = zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True)
    for value, exact in pairs:
        assert value.dtype == jnp.float32
        np.testing.assert_allclose(value, exact, atol=1e-6 + 3e-5 * np.abs(exact).max())


@pytest.mark.parametrize("name", ["sphere", "cone", "nurbs sphere"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_poles(name, dtype):
    """The normal is the limit along the meridian; the curvature that of the shape."""
    with jax.enable_x64(True):
        surface = in_dtype(surfaces()[name][0], dtype)
        domain = surface.domain()
        u, high = domain.u.low + 0.3 * domain.u.length, domain.v.high
        # At the pole, within its rounding, and beyond what counts as the pole.
        eps = jnp.finfo(dtype).eps
        near = [high - share * domain.v.length for share in (0, 2 * eps, eps**0.5)]
        uv = jnp.array([[u, v] for v in near], dtype)
        at = lambda x: (jp.normal(surface, x), jp.curvatures(surface, x))
        normals, bend = jax.jit(jax.vmap(at))(uv)
    slack = 64 * eps
    assert normals.dtype == dtype
    np.testing.assert_allclose(normals[0], normals[1], atol=slack)
    np.testing.assert_allclose(normals[0], normals[2], atol=16 * eps**0.5)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=slack)
    if name != "cone":
        np.testing.assert_allclose(normals[0], (0, 0, 1), atol=slack)
        # In a net the rounding of the points is not relative to their distance.
        rough = eps ** (1 / 3) if name == "nurbs sphere" else 60 * eps ** (2 / 3)
        np.testing.assert_allclose(bend.mean[0], 1 / 0.7, rtol=rough)
        np.testing.assert_allclose(bend.gaussian[0], 1 / 0.49, rtol=rough)


def test_degenerate_places_are_finite():
    """Where nothing is declared: normal and curvatures are zero, with finite slopes."""
    flat = jp.FunctionSurface(lambda uv: jnp.stack([uv[0], uv[0] ** 2, 0 * uv[1]]))
    uv = jnp.array([0.3, 0.4])
    slope = lambda x: jax.jacfwd(lambda x: jp.normal(flat, x))(x)
    at = jax.jit(lambda x: (jp.normal(flat, x), jp.curvatures(flat, x), slope(x)))
    normal, bend, slopes = at(uv)
    assert (normal == 0).all() and bend.mean == 0 and np.isfinite(slopes).all()


def test_curvatures_of_a_torus_and_an_ellipsoid(x64):
    torus, shape = jp.Torus(1.3, 0.4), jp.Ellipsoid((0.7, 0.4, 0.5))
    uv = parameters(torus, 64)
    found = jax.jit(jax.vmap(lambda x: jp.curvatures(torus, x)))(uv)
    along = jnp.cos(uv[:, 1]) / (1.3 + 0.4 * jnp.cos(uv[:, 1]))
    expected = jnp.stack([jnp.full(64, 2.5), along], axis=1)
    np.testing.assert_allclose(found.principal, expected, atol=1e-12)
    uv = parameters(shape, 64)
    points, found = jax.jit(jax.vmap(lambda x: (shape(x), jp.curvatures(shape, x))))(uv)
    lever = jnp.sum(points**2 / shape.radii**4, axis=1)
    gaussian = 1 / (jnp.prod(shape.radii) * lever) ** 2
    square = jnp.sum(shape.radii**2) - jnp.sum(points**2, axis=1)
    mean = square / (2 * jnp.prod(shape.radii) ** 2 * lever**1.5)
    np.testing.assert_allclose(found.gaussian, gaussian, rtol=1e-10)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-10)


def test_a_helicoid_is_minimal_and_an_offset_shifts_radii(x64):
    helicoid = in_dtype(surfaces()["helicoid"][0], jnp.float64)
    uv = parameters(helicoid, 16)
    found = jax.jit(jax.vmap(lambda x: jp.curvatures(helicoid, x)))(uv)
    rise, reach = 1.4 / (2 * np.pi), 0.9 * uv[:, 1]
    np.testing.assert_allclose(found.mean, 0, atol=1e-12)
    np.testing.assert_allclose(
        found.gaussian, -(rise**2) / (rise**2 + reach**2) ** 2, rtol=1e-11
    )
    torus = jp.Torus(1.3, 0.4)
    moved = jp.Offset(torus, -0.15)
    uv = parameters(torus, 4)
    both = jax.jit(
        jax.vmap(lambda x: (jp.curvatures(torus, x), jp.curvatures(moved, x)))
    )
    before, after = both(uv)
    np.testing.assert_allclose(
        1 / after.principal, 1 / before.principal - 0.15, rtol=1e-11
    )
