"""The examples in the docstrings run."""

import doctest
import importlib

import pytest

MODULES = {
    "shapes._polygons": 1,
    "subdivision._creases": 1,
    "subdivision._curves": 1,
    "subdivision._limit": 1,
    "subdivision._operator": 1,
    "subdivision._subdivide": 1,
}


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    found = doctest.testmod(importlib.import_module(f"jaxgeom.{name}"))
    assert found.failed == 0 and found.attempted >= MODULES[name]
