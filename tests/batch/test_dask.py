"""A batch on workers of Dask: no scan is lost with a worker, and none ends twice."""

import csv
import json
import os
import signal
import sys
import threading
import time

import numpy as np
import pytest

from jaxgeom import Rigid
from jaxgeom.batch import local_client, run_batch
from jaxgeom.batch._registering import _Key
from jaxgeom.batch._tasks import AbstractTask, Outcome
from jaxgeom.cli import main

dask = pytest.importorskip("dask")
pytest.importorskip("distributed")

_FEW_DEATHS = {"distributed.scheduler.allowed-failures": 1}


def _write(folder, rows):
    with open(folder / "list.csv", "w", newline="") as file:
        csv.writer(file).writerows([("id", "source", "target"), *rows])
    return str(folder / "list.csv")


def _states(out):
    found = [json.loads(p.read_text()) for p in out.glob("status/??/*.json")]
    assert len({state["id"] for state in found}) == len(found)
    return {state["id"]: state for state in found}


def test_a_scan_that_kills_its_workers_fails_alone(tmp_path):
    class Deadly(AbstractTask):
        """A scan is refused, kills the process, or ends well, by its name."""

        def input_hash(self, scan):
            return scan.id

        def read(self, scan):
            return _Key("", None, 4 + len(scan.id)), None

        def most(self, key, chunk):
            return chunk

        def program(self, key):
            return key

        def solve(self, key, scans, works, room, out):
            if any(scan.id == "s5" for scan in scans):
                os.kill(os.getpid(), signal.SIGKILL)
            return [Outcome("ok", "successful", str(room))] * len(scans)

    manifest = _write(
        tmp_path, [(f"s{i}", tmp_path / "any.npy", "") for i in range(30)]
    )
    out, said = tmp_path / "out", []
    choices = {"reconstructing": Deadly(), "chunk": 8, "tell": said.append}
    with dask.config.set(_FEW_DEATHS), local_client() as client:
        assert len(client.nthreads()) == len(os.sched_getaffinity(0))
        tally = run_batch(manifest, out, client=client, **choices)
    assert tally == {"ok": 29, "warning": 0, "failed": 1, "skipped": 0}
    states = _states(out)
    assert sorted(states) == sorted(f"s{i}" for i in range(30))
    bad = {name for name, state in states.items() if state["status"] != "ok"}
    assert bad == {"s5"} and states["s5"]["code"] == "worker_died"
    assert "memory" in states["s5"]["message"]
    assert any(line.startswith("30 of 30 scans") for line in said)
    # Chunks are for as many scans as those of a single process, even of one scan.
    assert {states[name]["message"] for name in states if name != "s5"} == {"8"}
    again = run_batch(manifest, out, reconstructing=Deadly(), chunk=8)
    assert again == {"ok": 29, "warning": 0, "failed": 1, "skipped": 30}


def test_workers_that_are_not_installed_are_asked_for(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    manifest = _write(tmp_path, [("a", tmp_path / "a.npy", "")])
    command = ["batch", manifest, "--out", str(tmp_path / "out"), "--dask", "local"]
    assert main(command) == 4
    assert "jaxgeom[scale]" in capsys.readouterr().err


@pytest.mark.slow
def test_a_killed_worker_loses_nothing(tmp_path):
    """States equal those of one process, though a worker is killed in the middle."""
    draw = np.random.default_rng(0)
    target = draw.normal(size=(250, 3)) * [1, 2, 3]
    np.save(tmp_path / "target.npy", target)
    rows = []
    for i in range(24):
        motion = Rigid.exp(draw.normal(size=6) * 0.05)
        scan = np.asarray(motion.inverse()(target[draw.permutation(250)[:220]]))
        np.save(tmp_path / f"s{i}.npy", scan)
        rows.append((f"s{i}", tmp_path / f"s{i}.npy", tmp_path / "target.npy"))
    np.save(tmp_path / "nan.npy", np.full((50, 3), np.nan))
    rows.append(("nan", tmp_path / "nan.npy", tmp_path / "target.npy"))
    manifest, out = _write(tmp_path, rows), tmp_path / "out"
    with local_client() as client:
        workers = list(client.run(os.getpid).values())

        def kill():
            while not any(s["status"] == "ok" for s in _states(out).values()):
                time.sleep(0.002)
            os.kill(workers[0], signal.SIGKILL)

        killer = threading.Thread(target=kill, daemon=True)
        killer.start()
        tally = run_batch(manifest, out, client=client, chunk=2)
        killer.join(timeout=1)
        assert workers[0] not in client.run(os.getpid).values()
    assert tally == {"ok": 24, "warning": 0, "failed": 1, "skipped": 0}
    run_batch(manifest, tmp_path / "plain", chunk=2)
    found, plain = _states(out), _states(tmp_path / "plain")
    assert sorted(found) == sorted(plain)
    for name, state in plain.items():
        for key in ("status", "code", "message", "input_hash"):
            assert found[name][key] == state[key]
        if state["transform"] is not None:
            found_pose, pose = found[name]["transform"], state["transform"]
            np.testing.assert_allclose(found_pose, pose, atol=1e-5)
