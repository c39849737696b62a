"""One picture of parametric surfaces: tessellated, swept, ruled, trimmed and fitted.

python experiments/parametric/gallery.py gallery.png
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import fields, render
from jaxgeom import parametric as jp

COLUMNS, SIZE = 3, 320
WARM, COLD = np.array([0.85, 0.35, 0.2]), np.array([0.2, 0.4, 0.8])


def painted(mesh, share):
    """A mesh with colors from cold (0) to warm (1)."""
    share = np.clip(np.asarray(share), 0, 1)[:, None]
    colors = jnp.asarray((1 - share) * COLD + share * WARM, jnp.float32)
    return type(mesh)(mesh.vertices, mesh.faces, mesh.normals, {"colors": colors})


def by_curvature(surface, resolution):
    """The tessellation, warm where the Gaussian curvature is positive."""
    mesh = jp.tessellate(surface, resolution)
    at = jax.jit(jax.vmap(lambda x: jp.curvatures(surface, x).gaussian))
    bend = np.asarray(at(mesh.attributes["uv"]))
    return painted(mesh, 0.5 + 0.5 * np.tanh(bend / np.median(np.abs(bend))))


def checkered(mesh, cells):
    """A mesh with the squares of its parameters."""
    uv = np.asarray(mesh.attributes["uv"])
    low, high = uv.min(axis=0), uv.max(axis=0)
    index = np.floor((uv - low) / (high - low) * cells * 0.9999).astype(int)
    return painted(mesh, index.sum(axis=1) % 2)


def trimmed():
    """A wavy rational patch with a star and a round hole cut out."""
    generator = np.random.default_rng(4)
    u, v = np.meshgrid(*[np.linspace(-1, 1, 7)] * 2, indexing="ij")
    heights = 0.25 * generator.normal(size=(7, 7))
    basis = jp.SplineBasis.clamped(7, 3)
    patch = jp.NurbsSurface(np.stack([u, v, heights], -1), (basis, basis))
    turn = lambda n: np.linspace(0, 2 * np.pi, n, endpoint=False)[:, None]
    around = lambda n: np.hstack([np.cos(turn(n)), np.sin(turn(n))])
    outline = 0.5 + 0.48 * around(64)
    reach = np.where(np.arange(10) % 2, 0.08, 0.19)[:, None]
    star, hole = (0.37, 0.4) + reach * around(10), (0.72, 0.65) + 0.12 * around(24)
    return jp.tessellate_trimmed(patch, [outline, star, hole], (56, 56))


def fitted():
    """A patch through 1 500 noisy points of a hat at unknown parameters."""
    generator = np.random.default_rng(5)
    xy = generator.uniform(-1, 1, (1500, 2))
    radius = np.linalg.norm(xy, axis=1)
    z = 0.5 * np.cos(5 * radius) * np.exp(-radius)
    points = np.column_stack([xy, z]) + 0.01 * generator.normal(size=(1500, 3))
    basis = jp.SplineBasis.clamped(10, 3)
    fit = jp.fit_surface(
        points, (basis, basis), parameters=(np.clip(xy, -1, 1) + 1) / 2, smoothing=1e-5
    )
    print(f"fitted patch: rmse {float(fit.rmse):.4f} for noise of {0.01 * 3**0.5:.4f}")
    return checkered(jp.tessellate(fit.shape, (80, 80)), 10)


def bodies():
    """Name -> mesh."""
    profile = jp.NurbsCurve(
        np.array(
            [[0, 0, -0.9], [0.9, 0, -0.9], [0.5, 0, 0], [0.2, 0, 0.3], [0.5, 0, 1]]
        ),
        jp.SplineBasis.clamped(5, 3),
    )
    vase = jp.nurbs_revolution(profile, poles=(True, False))
    knot = jp.Swept(jp.TorusKnot(0.75, 0.3, 2, 3), jp.Circle(0.17), stations=128)
    turn = jp.Interval(0, 2 * np.pi, periodic=True)
    ruled = jp.Ruled(jp.Circle(0.7, (0, 0, -0.8)), jp.FunctionCurve(oval, turn))
    return {
        "torus by Gaussian curvature": by_curvature(jp.Torus(0.75, 0.32), (96, 48)),
        "swept knot": checkered(jp.tessellate(knot, (32, 300)), (4, 60)),
        "ruled": checkered(jp.tessellate(ruled, (160, 40)), (24, 1)),
        "vase of revolution": by_curvature(vase, (80, 60)),
        "trimmed patch": trimmed(),
        "fitted patch": fitted(),
    }


def oval(t):
    """An ellipse in the height, begun a third of the way around."""
    t = t + 2 * jnp.pi / 3
    return jnp.stack([0.9 * jnp.cos(t), 0.4 * jnp.sin(t), 0.8 + 0 * t])


def picture(mesh):
    """One body from above the front."""
    camera = fields.Camera((1.9, -3.3, 2.1), field_of_view=36.0)
    return render.render_mesh(mesh, camera, size=(SIZE, SIZE), samples=3)


def main(path):
    """Render all and write one PNG."""
    tiles = [picture(mesh) for mesh in bodies().values()]
    rows = [np.hstack(tiles[i : i + COLUMNS]) for i in range(0, len(tiles), COLUMNS)]
    render.save_png(path, np.vstack(rows))


if __name__ == "__main__":
    main(sys.argv[1])
