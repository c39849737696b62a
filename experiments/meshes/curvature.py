"""Curvatures of sphere, torus and ellipsoid: errors and orders, beside libigl (CPU).

    python experiments/meshes/curvature.py

Root mean square errors over the area (and the largest error) relative to the root mean
square of the true curvature, in percent, and the order of convergence of the former
from mesh to mesh of half the edge. Double precision. Of libigl: the mean curvature of
its cotangent Laplacian and mixed areas, its angle defects over these, and its quadric
fit for principal curvatures. Jets are those of the vertices as a cloud, with the
normals of the mesh. The operators themselves are compared entry by entry.
"""

import igl
import jax
import numpy as np

from jaxgeom import TriangleMesh, clouds, convert
from jaxgeom.meshes import (
    MixedVoronoiAreas,
    cotangent_laplacian,
    gaussian_curvature,
    icosphere,
    lumped_mass,
    mean_curvature,
    principal_curvatures,
    torus_mesh,
)

SHAPE = np.array([1.3, 0.9, 0.7])


def sphere(n):
    """A sphere of radius 1.3 and its curvatures."""
    mesh = icosphere(n + 1, radius=1.3)
    k = np.full(mesh.vertices.shape[0], 1 / 1.3)
    return mesh, k, k


def torus(n):
    """A torus and its curvatures."""
    mesh = torus_mesh(1.6, 0.45, around=24 * 2**n, across=9 * 2**n)
    reach = np.hypot(*np.asarray(mesh.vertices)[:, :2].T)
    k2 = (reach - 1.6) / 0.45 / reach
    return mesh, np.full_like(k2, 1 / 0.45), k2


def ellipsoid(n):
    """An ellipsoid (a stretched icosphere) and its curvatures."""
    ball = icosphere(n + 1)
    mesh = TriangleMesh(ball.vertices * SHAPE, ball.faces)
    p = np.asarray(mesh.vertices)
    height = 1 / np.linalg.norm(p / SHAPE**2, axis=1)
    product = np.prod(SHAPE) ** 2
    gauss = height**4 / product
    mean = height**3 * (np.sum(SHAPE**2) - np.sum(p**2, axis=1)) / (2 * product)
    root = np.sqrt(np.maximum(mean**2 - gauss, 0))
    return mesh, mean + root, mean - root


@jax.jit
def ours(mesh):
    """H, K, k1, k2."""
    k = principal_curvatures(mesh).values
    return mean_curvature(mesh), gaussian_curvature(mesh), k[:, 0], k[:, 1]


def jets(degree, k):
    """The same from a polynomial around every vertex."""

    @jax.jit
    def found(mesh):
        cloud = convert.vertices_to_cloud(mesh)
        k1, k2 = clouds.principal_curvatures(cloud, k=k, degree=degree).values.T
        return (k1 + k2) / 2, k1 * k2, k1, k2

    return found


def of_libigl(mesh):
    """The same from libigl."""
    v, f = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    mass = igl.massmatrix(v, f, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    vectors = -(igl.cotmatrix(v, f) @ v) / (2 * mass[:, None])
    normals = igl.per_vertex_normals(v, f)
    fitted = igl.principal_curvature(v, f)
    low, high = np.sort(np.stack([fitted[2], fitted[3]]), axis=0)
    return np.sum(vectors * normals, 1), igl.gaussian_curvature(v, f) / mass, high, low


def errors(found, truth, mass):
    """Root mean square and largest error, in percent of the true root mean square."""
    size = np.sqrt(np.sum(mass * truth**2))
    gap = np.asarray(found) - truth
    return 100 * np.sqrt(np.sum(mass * gap**2)) / size, 100 * np.abs(gap).max() / size


def compare_operators():
    """The largest differences of the Laplacian and of the mixed areas."""
    mesh = ellipsoid(2)[0]
    v, f = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    gap = cotangent_laplacian(mesh).to_scipy() + igl.cotmatrix(v, f)
    mass = igl.massmatrix(v, f, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    areas = np.asarray(lumped_mass(mesh, areas=MixedVoronoiAreas())) - mass
    print(
        f"largest difference: Laplacian {abs(gap).max():.1e},"
        f" areas {abs(areas).max():.1e}"
    )


METHODS = {
    "mesh": ours,
    "jets 3": jets(3, 24),
    "jets 4": jets(4, 32),
    "libigl": of_libigl,
}


def main():
    """The table."""
    jax.config.update("jax_enable_x64", True)
    compare_operators()
    for shape in (sphere, torus, ellipsoid):
        last = {}
        for n in range(4):
            mesh, k1, k2 = shape(n)
            truths = ((k1 + k2) / 2, k1 * k2, k1, k2)
            mass = np.asarray(lumped_mass(mesh))
            mass = mass / mass.sum()
            for who, method in METHODS.items():
                found, parts = method(mesh), []
                for name, x, truth in zip(
                    "H K k1 k2".split(), found, truths, strict=True
                ):
                    rms, most = errors(x, truth, mass)
                    rate = np.log2(last.get((who, name), np.nan) / rms)
                    last[who, name] = rms
                    parts.append(f"{name} {rms:8.2g} ({most:8.2g}) {rate:5.2f}")
                print(
                    f"{shape.__name__:9s} {len(mass):6d} {who:8s} " + "  ".join(parts)
                )


if __name__ == "__main__":
    main()
