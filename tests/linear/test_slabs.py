"""Grids in slabs over several devices: as on one, with less memory on each."""

import json
import os
import pathlib
import socket
import subprocess
import sys

import jax
import numpy as np
import pytest
from jax.sharding import Mesh

from jaxgeom import GeometryError
from jaxgeom.linear import SlabCosine, SlabMultigrid, solve_in_slabs

_CASE = pathlib.Path(__file__).with_name("slabs_case.py")
_EPS = float(np.finfo(np.float32).eps)


def _start(devices, *arguments):
    """The case in a process of its own: the number of devices is fixed at start."""
    flags = f"--xla_force_host_platform_device_count={devices}"
    settings = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    settings["PYTHONPATH"] = os.pathsep.join(sys.path)
    if cache := os.environ.get("JAXGEOM_TEST_CACHE"):
        settings["JAX_COMPILATION_CACHE_DIR"] = cache
    command = [sys.executable, str(_CASE), *map(str, arguments)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, env=settings, stdout=pipe, stderr=pipe, text=True)


def _told(process):
    out, err = process.communicate(timeout=400)
    assert process.returncode == 0, err[-3000:]
    return json.loads(out.strip().splitlines()[-1])


def _check(devices):
    told = _told(_start(devices))
    assert told["devices"] == devices
    multigrid, cosine = told["SlabMultigrid"], told["SlabCosine"]
    # The same V-cycle: the same steps, and the same iterates up to rounding.
    assert multigrid["steps"] == told["steps"] and multigrid["gap"] < 100 * _EPS
    # Another preconditioner: as near as two residuals of 1e-4 may be.
    assert cosine["residual"] <= 1e-4 and cosine["gap"] < 1e-3
    assert told["free_steps"] == 1 and told["free_gap"] < 100 * _EPS
    for method in (multigrid, cosine):
        held = method["memory"]
        assert held == sorted(held, reverse=True) and held[-1] < held[0]
    # Transforms keep nothing whole; levels of at most 32 nodes an axis are kept whole.
    assert cosine["memory"][-1] < 1.35 * cosine["memory"][0] / devices
    assert multigrid["memory"][-1] < multigrid["memory"][0] / 4


@pytest.mark.slow
def test_four_devices_solve_as_one_does():
    _check(4)


@pytest.mark.slow
def test_eight_devices_solve_as_one_does():
    _check(8)


@pytest.mark.slow
def test_two_processes_solve_as_one_does():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    runs = [_start(2, port, index) for index in range(2)]
    try:
        for told in map(_told, runs):
            assert told["processes"] == 2 and told["parts"] == 2
            assert told["steps"] == told["one"] and told["gap"] < 1e-5
    finally:
        for run in runs:
            run.kill()


@pytest.mark.parametrize("method", [SlabCosine(), SlabMultigrid()])
def test_a_mesh_of_two_axes_is_refused(method):
    mesh = Mesh(np.array(jax.devices()[:1]).reshape(1, 1), ("x", "y"))
    b = np.ones((8, 6, 5), np.float32)
    with pytest.raises(GeometryError, match="devices of one axis"):
        solve_in_slabs(b, b, np.ones(3, np.float32), mesh=mesh, method=method, rtol=1)
