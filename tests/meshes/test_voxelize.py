"""Mesh to values to mesh, and to a field."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom.fields import Sampled
from jaxgeom.isosurface import extract
from jaxgeom.meshes import point_to_mesh, report, torus_mesh, volume, voxelize
from jaxgeom.shapes import Grid

from .shapes_for_tests import moved, sized


@pytest.mark.slow
def test_a_mesh_comes_back(x64):
    mesh = moved(torus_mesh(1.6, 0.45, around=40, across=21), (0.3, -1.0, 0.2))
    found = []
    for n in (16, 31):
        shape = (2 * n, 2 * n + 3, n)
        spacing = jnp.array([4.6, 4.6, 1.4]) / (n * np.array([2, 2, 1]) - 1)
        grid = Grid(jnp.array([-2.0, -3.3, -0.5]), spacing, shape)
        values = jax.jit(voxelize)(sized(mesh, 900, 1750), grid)
        inside = np.mean(np.asarray(values) < 0)
        box = float(jnp.prod(spacing)) * np.prod(shape)
        assert inside * box == pytest.approx(float(volume(mesh)), rel=0.03)
        out = extract(values, grid).mesh
        checked = report(out)
        assert checked.is_clean and checked.euler == 0
        found.append(float(point_to_mesh(out.vertices, mesh).rms))
        at = Sampled(grid, values)(jnp.array([1.9, -1.0, 0.2]))
        assert at == pytest.approx(-0.45, abs=2 * float(jnp.max(spacing)))
    assert found[1] < 0.5 * found[0] < 0.01
