"""Every field keeps its promises: one program for each family measures them all."""

import functools
import importlib.util
import pathlib

import jax
import jax.numpy as jnp
import pytest

from jaxgeom.fields._check import contract, probes

_spec = importlib.util.spec_from_file_location(
    "shapes", pathlib.Path(__file__).with_name("shapes.py")
)
shapes = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(shapes)

FAMILIES = {"solids": shapes.solids, "profiles": shapes.profiles}
NAMES = [(family, name) for family in FAMILIES for name in FAMILIES[family]()]
# The programs run once, on few points: what counts is how fast they compile.
QUICK = {"xla_llvm_disable_expensive_passes": True, "xla_backend_optimization_level": 0}


@functools.cache
def measured(family):
    with jax.enable_x64(True):
        fields = FAMILIES[family]()
        seen = {name: field.claims() for name, field in fields.items()}
        points = {
            name: jax.tree.map(jnp.asarray, probes(seen[name].bounds, 400, seed))
            for seed, name in enumerate(fields)
        }
        run = jax.jit(
            lambda f, p, s: {k: contract(f[k], *p[k], s[k]) for k in f},
            compiler_options=QUICK,
        )
        return jax.device_get(run(fields, points, seen)), seen


@pytest.mark.parametrize(("family", "name"), NAMES)
def test_promises_are_kept(family, name):
    found, seen = (table[name] for table in measured(family))
    assert found.finite
    assert found.steepness < 1e-9
    assert found.outside < 1e-9 and found.inside < 1e-9
    assert found.box < 1e-9 and found.growth < 1e-9
    assert seen.lipschitz > 0
