"""What all tests share: the real data, double precision, the compile cache."""

import gc
import os
import pathlib

import jax
import pytest

_CACHE = os.environ.get("JAXGEOM_TEST_CACHE")
if _CACHE:
    jax.config.update("jax_compilation_cache_dir", _CACHE)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


@pytest.fixture
def data() -> pathlib.Path:
    """The folder of real scans, named by the variable JAXGEOM_DATA."""
    folder = os.environ.get("JAXGEOM_DATA")
    if not folder:
        pytest.skip("JAXGEOM_DATA is not set: it names the folder of real scans")
    return pathlib.Path(folder)


@pytest.fixture
def x64():
    """Double precision within one test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module", autouse=True)
def _programs_are_dropped():
    """Compiled programs hold memory maps, of which a process may have 65 530."""
    yield
    jax.clear_caches()
    gc.collect()
