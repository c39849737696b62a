"""What all tests share: the real data, double precision, the compile cache."""

import gc
import os
import pathlib
import subprocess
import sys

import jax
import numpy as np
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


@pytest.fixture
def on_devices(tmp_path):
    """A function that runs code, which must save arrays at sys.argv[1], in a process of
    its own with a number of CPU devices, and returns the arrays."""

    def run(code, count):
        flags = f"--xla_force_host_platform_device_count={count}"
        path = tmp_path / f"{count}.npz"
        env = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
        subprocess.run([sys.executable, "-c", code, str(path)], check=True, env=env)
        return np.load(path)

    return run


@pytest.fixture(scope="module", autouse=True)
def _programs_are_dropped():
    """Compiled programs hold memory maps, of which a process may have 65 530."""
    yield
    jax.clear_caches()
    gc.collect()
