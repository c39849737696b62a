"""One small size for all tests of learned fields, so that programs are shared."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxgeom import PointCloud, learning

SMALL = {"width": 8, "depth": 2}
CODE = 3


def networks():
    """Every kind of learned field, by name."""
    key = jax.random.key(3)
    decoder = learning.Decoder.create(CODE, key=key, num_frequencies=4, **SMALL)
    siren = learning.NeuralField.siren(key=key, radius=0.3, **SMALL)
    fourier = learning.NeuralField.fourier(key=key, num_frequencies=4, **SMALL)
    code = jnp.asarray([0.3, -0.2, 0.1])
    return {
        "siren": siren,
        "fourier": fourier,
        "latent": decoder.field(code),
        "unsigned": learning.Unsigned(siren),
    }


def ellipsoid_cloud(n=40, seed=0):
    """Points of an ellipsoid in the unit box, with normals, in double precision."""
    rng = np.random.default_rng(seed)
    ball = rng.normal(size=(n, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    axes = np.array([0.45, 0.3, 0.25])
    return PointCloud(ball * axes, ball / axes)


def padded(cloud, rows):
    """The cloud with `rows` of garbage behind it, masked out."""
    more = lambda x: np.concatenate([x, np.full((rows, 3), np.nan)])
    mask = np.arange(len(cloud.points) + rows) < len(cloud.points)
    return PointCloud(more(cloud.points), more(cloud.normals), mask)


def shaken(model, seed=5):
    """The model with all weights moved: its last layer is zero at first."""
    leaves, structure = jax.tree.flatten(model)
    rng = np.random.default_rng(seed)
    moved = [
        x + jnp.asarray(0.2 * rng.normal(size=x.shape), x.dtype)
        if hasattr(x, "dtype")
        else x
        for x in leaves
    ]
    return jax.tree.unflatten(structure, moved)
