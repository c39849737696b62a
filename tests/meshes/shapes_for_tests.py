"""Meshes without symmetry, padded meshes and meshes with known defects."""

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from jaxgeom.meshes import box_mesh, icosphere, torus_mesh
from jaxgeom.shapes import TriangleMesh


def bent(mesh, shift=(0.3, -1.7, 2.2)):
    """The mesh mapped by an affine map of determinant > 0, away from the origin."""
    matrix = jnp.array([[1.3, 0.2, -0.1], [0.0, 0.8, 0.3], [0.2, -0.4, 1.7]])
    vertices = mesh.vertices @ matrix.T.astype(mesh.vertices.dtype)
    return TriangleMesh(vertices + jnp.array(shift, vertices.dtype), mesh.faces)


def closed_meshes():
    """name -> a closed mesh without symmetry."""
    return {
        "sphere": bent(icosphere(2, radius=1.4)),
        "box": bent(box_mesh((0.7, 2.1, 1.3), subdivisions=1)),
        "torus": bent(torus_mesh(1.6, 0.45, around=13, across=9)),
    }


def padded(mesh, more_vertices=7, more_faces=5, garbage=np.nan):
    """The same mesh in larger arrays; the padding vertices hold `garbage`."""
    v, f = mesh.vertices.shape[0], mesh.faces.shape[0]
    vertices = jnp.pad(
        mesh.vertices, ((0, more_vertices), (0, 0)), constant_values=garbage
    )
    faces = jnp.pad(
        mesh.faces, ((0, more_faces), (0, 0)), constant_values=v + more_vertices
    )
    counts = {"num_vertices": jnp.int32(v), "num_faces": jnp.int32(f)}
    return TriangleMesh(vertices, faces, **counts)


def joined(*meshes):
    """The meshes side by side in one, not connected."""
    offsets = np.cumsum([0] + [m.vertices.shape[0] for m in meshes])
    faces = [m.faces + o for m, o in zip(meshes, offsets, strict=False)]
    return TriangleMesh(
        jnp.concatenate([m.vertices for m in meshes]), jnp.concatenate(faces)
    )


def moved(mesh, shift):
    return TriangleMesh(mesh.vertices + jnp.asarray(shift), mesh.faces)


def with_faces(mesh, faces):
    return TriangleMesh(mesh.vertices, jnp.asarray(faces, jnp.int32))


def peer(mesh):
    """The mesh in trimesh, untouched."""
    return trimesh.Trimesh(
        np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), process=False
    )


def stacked(*meshes):
    return jax.tree.map(lambda *x: jnp.stack([jnp.asarray(y) for y in x]), *meshes)


def central_difference(function, x, direction, step=1e-5):
    """The derivative of `function` at x along `direction`, in one jitted call."""
    both = jax.jit(
        lambda x: (
            (function(x + step * direction) - function(x - step * direction))
            / (2 * step)
        )
    )
    return both(x)


def slope_and_difference(function, x, way, step=1e-6):
    """The gradient at x, the derivative along `way` by it and by differences.

    One program gives all three.
    """
    run = jax.jit(jax.value_and_grad(function))
    slope = np.asarray(run(x)[1])
    numeric = (run(x + step * way)[0] - run(x - step * way)[0]) / (2 * step)
    return slope, float(np.vdot(slope, way)), float(numeric)


def sized(mesh, v=900, f=1750, dtype=float, garbage=np.nan):
    """The mesh in arrays of one canonical size, so that tests share programs."""
    vertices = np.full((v, 3), garbage)
    vertices[: mesh.vertices.shape[0]] = mesh.vertices
    faces = np.full((f, 3), v, np.int32)
    faces[: mesh.faces.shape[0]] = mesh.faces
    counts = {
        "num_vertices": np.int32(mesh.vertices.shape[0]),
        "num_faces": np.int32(mesh.faces.shape[0]),
    }
    return TriangleMesh(jnp.asarray(vertices, dtype), jnp.asarray(faces), **counts)


def cut(mesh, last=-20):
    """The mesh without its last faces."""
    return TriangleMesh(mesh.vertices, np.asarray(mesh.faces)[:last])


def flat_patch():
    """A plane in space with a triangulation of a jittered lattice of 7 x 6."""
    i, j = (x.ravel() for x in np.meshgrid(range(7), range(6), indexing="ij"))
    u, w = np.stack([i, j]) + 0.25 * np.random.default_rng(3).uniform(-1, 1, (2, 42))
    node = lambda di, dj: ((i + di) * 6 + j + dj)[(i < 6) & (j < 5)]
    lower = np.stack([node(0, 0), node(1, 0), node(1, 1)], -1)
    upper = np.stack([node(0, 0), node(1, 1), node(0, 1)], -1)
    plane = np.stack([0.7 * u + 0.2 * w, 0.9 * w, 0.4 * u - 0.3 * w + 2], -1)
    return TriangleMesh(plane, np.concatenate([lower, upper]))
