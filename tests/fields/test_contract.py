"""Every field keeps its promises: one program for each family measures them all."""

import functools
import importlib.util
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxgeom import fields as jf
from jaxgeom.fields._check import contract, probes


def _load(name):
    spec = importlib.util.spec_from_file_location(
        name, pathlib.Path(__file__).with_name(f"{name}.py")
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


shapes, nodes = _load("shapes"), _load("nodes")
FAMILIES = {
    "solids": shapes.solids,
    "profiles": shapes.profiles,
    "combinations": nodes.combinations,
    "deformations": nodes.deformations,
    "written": nodes.written,
}
# One of every kind of formula; the others are looked at with the slow tests.
QUICK = {
    *("box_frame", "capped_torus", "round_tube", "exact_ellipsoid", "pyramid"),
    *("death_star", "infinite_cone", "bezier", "triangle", "polytope"),
    *("polygon", "moon", "arc", "xor", "hole", "stacked", "box_shell"),
    *("grown_affine", "twisted", "mirrored", "row", "barth", "gyroid", "metaballs"),
    *("tricubic", "bush"),
}


@functools.cache
def measured(family, *, quick):
    """(contract, claims) of all fields of a family, or of the quick ones."""
    with jax.enable_x64(True):
        fields = {
            k: f for k, f in FAMILIES[family]().items() if k in QUICK or not quick
        }
        seen = {name: field.claims() for name, field in fields.items()}
        points = {
            name: jax.tree.map(jnp.asarray, probes(seen[name].bounds, 400, seed))
            for seed, name in enumerate(fields)
        }
        run = jax.jit(lambda f, p, s: {k: contract(f[k], *p[k], s[k]) for k in f})
        return jax.device_get(run(fields, points, seen)), jax.device_get(seen)


def check(family, *, quick):
    found, seen = measured(family, quick=quick)
    for name, one in found.items():
        assert one.finite, name
        errors = one.outside, one.inside, one.box, one.growth
        assert max(errors) < 1e-9, (name, errors)
        assert seen[name].lipschitz > 0 or name == "occupancy", name
        assert not one.steepness > 1e-9, (name, one.steepness)


@pytest.mark.parametrize("family", FAMILIES)
def test_promises_are_kept(family):
    check(family, quick=True)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_all_promises_are_kept(family):
    check(family, quick=False)


def test_the_quick_ones_exist():
    with jax.enable_x64(True):
        assert QUICK <= {name for make in FAMILIES.values() for name in make()}


def test_a_broken_field_is_found():
    report = jf.check_field(lambda p: jnp.linalg.norm(p) - 0.5, count=50)
    assert not report.kept and "BROKEN: values and gradients" in str(report)
    steep = jf.declare(lambda p: 1.5 * p[0], lipschitz=1.0)
    assert "BROKEN: the Lipschitz constant is 1, the largest slope 1.5" in str(
        jf.check_field(steep, count=50)
    )
    slow = jf.declare(lambda p: 0.9 * p[0], lipschitz=1.0, exactness=jf.DISTANCE)
    found = str(jf.check_field(slow, count=50))
    assert "BROKEN: the distance is exact outside" in found
    low, high = (-0.4, -0.6, -0.6), (0.6, 0.6, 0.6)
    small = jf.declare(jf.Sphere(0.5), lipschitz=1.0, low=low, high=high)
    assert "BROKEN: the body lies in its box" in str(jf.check_field(small))
    rough = jf.declare(lambda p: p[0] + 1e6 - 1e6, lipschitz=1.0)
    assert "BROKEN: float32" in str(jf.check_field(rough, count=50))


def test_a_sound_field_passes():
    report = jf.check_field(jf.Box((0.5, 0.3, 0.7), (0.1, -0.2, 0.15)), count=200)
    assert report.kept and "BROKEN" not in str(report) and len(report.lines) == 9
    assert np.isfinite(report.contract.steepness)
