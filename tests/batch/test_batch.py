"""Manifests, shards and states; bad scans fail alone; killed runs go on."""

import csv
import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from scipy.spatial import cKDTree

from jaxgeom import GeometryError, PointCloud, Rigid, register
from jaxgeom.batch import (
    Registering,
    Shard,
    read_manifest,
    run_batch,
    shard_of,
    shard_of_environment,
    warm_up,
)
from jaxgeom.cli import main
from jaxgeom.io import load_mesh, save_cloud
from jaxgeom.pipelines import Pyramid, _register_many, choose_voxel_size

_BAD = {
    "gone": "source_unreadable",
    "empty": "source_unreadable",
    "nan": "source_too_few_points",
    "equal": "source_degenerate",
    "away": "no_overlap",
}


def _lumps(count, seed):
    """Points on a closed surface without symmetries."""
    d = np.random.default_rng(seed).normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    x, y, z = d.T
    waves = 0.15 * np.sin(3 * x + 1) * np.cos(4 * y) + 0.1 * np.sin(5 * z + 2 * x)
    return d * (1 + 0.2 * x + waves)[:, None]


def _motion(seed):
    """The pose that lays scan `seed` on the target."""
    draw = np.random.default_rng(1000 + seed)
    twist = np.concatenate([draw.normal(size=3) * 0.03, draw.normal(size=3) * 0.06])
    return np.asarray(Rigid.exp(twist).matrix(), np.float64)


def _good(folder, seed):
    """The file of a scan that `_motion(seed)` lays on the target."""
    motion = _motion(seed)
    points = (_lumps(200 + seed, seed) - motion[:3, 3]) @ motion[:3, :3]
    np.save(folder / f"s{seed}.npy", points)
    return folder / f"s{seed}.npy"


def _write(folder, rows, name="list.csv"):
    with open(folder / name, "w", newline="") as file:
        csv.writer(file).writerows([("id", "source", "target"), *rows])
    return str(folder / name)


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """Six scans, five bad ones, and the manifest of all."""
    folder = tmp_path_factory.mktemp("work")
    np.save(folder / "target.npy", _lumps(250, 99))
    target = folder / "target.npy"
    rows = [(f"s{i}", _good(folder, i), target) for i in range(5)]
    rows += [("s5", f"file://{_good(folder, 5)}", f"file://{target}")]
    (folder / "empty.npy").write_bytes(b"")
    np.save(folder / "nan.npy", np.full((50, 3), np.nan))
    np.save(folder / "equal.npy", np.full((50, 3), 2.5))
    np.save(folder / "away.npy", _lumps(220, 7) + 1000.0)
    rows += [(name, folder / f"{name}.npy", target) for name in _BAD]
    return folder, _write(folder, rows)


def _states(out):
    found = [json.loads(p.read_text()) for p in out.glob("status/??/*.json")]
    assert len({state["id"] for state in found}) == len(found)
    return {state["id"]: state for state in found}


def test_bad_scans_fail_alone_and_a_rerun_skips(work, tmp_path, capsys):
    _, manifest = work
    out, table = tmp_path / "out", tmp_path / "table.csv"
    command = ["batch", manifest, "--out", str(out), "--chunk", "8"]
    assert main(command) == 6
    assert capsys.readouterr().out == "6 ok, 0 warning, 5 failed, 0 skipped\n"
    found = _states(out)
    for i in range(6):
        state = found[f"s{i}"]
        assert state["status"] == "ok" and state["fitness"] > 0.9
        np.testing.assert_allclose(state["transform"], _motion(i), atol=0.03)
    assert {name: found[name]["code"] for name in _BAD} == _BAD
    assert "No source point has a target" in found["away"]["message"]
    assert all(len(found[name]["message"]) > 20 for name in _BAD)
    times = {p: p.stat().st_mtime_ns for p in out.glob("status/??/*.json")}
    assert main(command) == 6
    assert capsys.readouterr().out == "6 ok, 0 warning, 5 failed, 11 skipped\n"
    assert times == {p: p.stat().st_mtime_ns for p in times}
    assert main([*command, "--retry-failed"]) == 6
    changed = {p.stem for p in times if times[p] != p.stat().st_mtime_ns}
    assert changed == set(_BAD)
    assert main(["batch-status", str(out)]) == 6
    assert "1 failed: no_overlap" in capsys.readouterr().out
    assert main(["batch-collect", str(out), "-o", str(table)]) == 0
    rows = list(csv.DictReader(table.open()))
    assert {row["id"]: row["code"] for row in rows if row["status"] == "failed"} == _BAD
    row = next(row for row in rows if row["id"] == "s3")
    assert float(row["t03"]) == found["s3"]["transform"][0][3]


def test_a_changed_scan_is_done_again(work, tmp_path, capsys):
    folder, _ = work
    np.save(tmp_path / "s.npy", np.full((3, 3), np.nan))
    rows = [("s", tmp_path / "s.npy", folder / "target.npy")]
    command = ["batch", _write(tmp_path, rows), "--out", str(tmp_path / "out")]
    assert main(command) == 6
    first = _states(tmp_path / "out")["s"]
    np.save(tmp_path / "s.npy", np.full((4, 3), np.nan))
    assert main(command) == 6
    second = _states(tmp_path / "out")["s"]
    assert "3 in" in first["message"] and "4 in" in second["message"]
    assert first["input_hash"] != second["input_hash"]


def test_shards_are_a_partition_and_come_from_array_jobs():
    names = [f"scan{i}" for i in range(300)]
    held = [[n for n in names if Shard(i, 7).holds(n)] for i in range(7)]
    assert sorted(sum(held, [])) == sorted(names)
    assert all(20 < len(part) < 70 for part in held)
    assert shard_of("2/5") == Shard(2, 5)
    slurm = {"SLURM_ARRAY_TASK_ID": "3", "SLURM_ARRAY_TASK_COUNT": "4"}
    slurm |= {"SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_MAX": "4"}
    assert shard_of_environment(slurm) == Shard(2, 4)
    pod = {"JOB_COMPLETION_INDEX": "3"}
    assert shard_of_environment({**pod, "JOB_COMPLETIONS": "9"}) == Shard(3, 9)
    assert shard_of_environment({}) == Shard(0, 1)
    with pytest.raises(GeometryError, match="without JOB_COMPLETIONS"):
        shard_of_environment(pod)
    for part in ({"MIN": "3", "MAX": "3", "COUNT": "1"}, {"MAX": "7", "COUNT": "3"}):
        some = slurm | {f"SLURM_ARRAY_TASK_{k}": v for k, v in part.items()}
        with pytest.raises(GeometryError, match="Pass --shard"):
            shard_of_environment(some)
    for text in ("5/5", "1", "a/b", "-1/3"):
        with pytest.raises(GeometryError, match="must be i/n"):
            shard_of(text)


def test_manifests_of_both_forms_and_their_errors(tmp_path):
    path = tmp_path / "list.jsonl"
    good = {"id": "a", "source": "x", "target": "y", "parameters": {"voxel_size": 2}}
    path.write_text(json.dumps(good) + "\n\n")
    (scan,) = read_manifest(path)
    assert (scan.id, scan.voxel_size, scan.init) == ("a", 2.0, None)
    path.write_text(json.dumps({"id": "b", "source": "x"}))
    assert next(read_manifest(path)).target is None
    own = {"resolution": 32, "trim": 0.3}
    path.write_text(json.dumps({"id": "b", "source": "x", "parameters": own}))
    scan = next(read_manifest(path))
    assert (scan.resolution, scan.trim, scan.voxel_size) == (32, 0.3, None)
    wrong = [
        {"id": "a", "source": "x", "init": "mean"},
        {**good, "target": 3},
        {**good, "id": "../a"},
        {**good, "source": 3},
        {**good, "colour": 1},
        {**good, "parameters": {"voxel_size": -1}},
        {**good, "parameters": {"speed": 1}},
        {**good, "parameters": own},
        {"id": "a", "source": "x", "parameters": {"resolution": 12.5}},
        {"id": "a", "source": "x", "parameters": {"voxel_size": 1}},
    ]
    for row in wrong:
        path.write_text(json.dumps(row))
        with pytest.raises(GeometryError, match="line 1: a line must hold"):
            list(read_manifest(path))
    twice = _write(tmp_path, [("a", "x", "y"), ("a", "z", "y")])
    assert main(["batch", twice, "--out", str(tmp_path / "out")]) == 4
    assert not (tmp_path / "out").exists()


def _driver(manifest, out, *more, before=""):
    """A process of its own that runs the command line."""
    command = ["batch", manifest, "--out", str(out), "--chunk", "2", *more]
    code = (
        f"{before}\nfrom jaxgeom.cli import main\nimport sys\nsys.exit(main({command}))"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "XDG_CACHE_HOME": os.path.dirname(manifest)},
    )


@pytest.mark.parametrize(
    "oriented", [True, pytest.param(False, marks=pytest.mark.slow)]
)
def test_scans_without_a_target_are_reconstructed(tmp_path, capsys, oriented):
    """Bad ones fail alone; meshes lie where the states say, and near the scans."""
    scans = {f"m{i}": _lumps(210 + 20 * i, i) for i in range(3)}
    scans["line"] = np.linspace(0, 1, 90)[:, None] * np.ones(3)
    scans["few"] = scans["m0"][:3]
    for name, points in scans.items():
        # The lumps are seen whole from their center.
        outward = points / np.linalg.norm(points + 1e-9, axis=1, keepdims=True)
        cloud = PointCloud(points, outward if oriented else None)
        save_cloud(tmp_path / f"{name}.ply", cloud)
    (tmp_path / "gone.ply").write_bytes(b"ply")
    rows = [(name, tmp_path / f"{name}.ply", "") for name in scans]
    rows += [("gone", tmp_path / "gone.ply", "")]
    manifest, out = _write(tmp_path, rows), tmp_path / "out"
    command = ["batch", manifest, "--out", str(out), "--chunk", "8"]
    command += ["--resolution", "24", "--orientation-points", "128"]
    assert main(command) == 6
    assert capsys.readouterr().out == "3 ok, 0 warning, 3 failed, 0 skipped\n"
    found = _states(out)
    codes = {name: found[name]["code"] for name in ("line", "few", "gone")}
    assert list(codes.values()) == [
        *("degenerate_input", "too_few_points", "source_unreadable")
    ]
    assert all(len(found[name]["message"]) > 20 for name in codes)
    for i in range(3):
        state = found[f"m{i}"]
        mesh = load_mesh(out / state["mesh"])
        assert state["watertight"] and state["faces"] == len(mesh.faces)
        gaps = cKDTree(mesh.vertices).query(scans[f"m{i}"])[0]
        assert gaps.max() < 0.15
    assert not list(out.rglob(".*"))
    assert main(command) == 6
    assert capsys.readouterr().out == "3 ok, 0 warning, 3 failed, 6 skipped\n"
    if not oriented:
        # A single scan is a program of its own.
        (out / found["m1"]["mesh"]).unlink()
        assert main(command) == 6
        assert capsys.readouterr().out == "3 ok, 0 warning, 3 failed, 5 skipped\n"
    table = tmp_path / "table.csv"
    assert main(["batch-collect", str(out), "-o", str(table)]) == 0
    row = next(row for row in csv.DictReader(table.open()) if row["id"] == "m2")
    assert (out / row["mesh"]).exists() and row["watertight"] == "True"


@pytest.mark.slow
def test_lines_have_their_own_resolution_and_trim(tmp_path):
    """A finer mesh, and one that is open where half of the scan is missing."""
    points = _lumps(400, 1)
    outward = points / np.linalg.norm(points + 1e-9, axis=1, keepdims=True)
    half = points[:, 0] < 0.3
    save_cloud(tmp_path / "whole.ply", PointCloud(points, outward))
    save_cloud(tmp_path / "half.ply", PointCloud(points[half], outward[half]))
    line = lambda name, source, **own: json.dumps(
        {"id": name, "source": str(tmp_path / source), "parameters": own}
    )
    lines = [
        line("coarse", "whole.ply", resolution=24),
        line("fine", "whole.ply", resolution=48),
        line("open", "half.ply", trim=0.3),
        line("closed", "half.ply"),
    ]
    manifest, out = tmp_path / "list.jsonl", tmp_path / "out"
    manifest.write_text("\n".join(lines))
    command = ["batch", str(manifest), "--out", str(out), "--resolution", "24"]
    assert main(command) == 0
    found = _states(out)
    assert all(state["status"] == "ok" for state in found.values())
    assert found["fine"]["faces"] > 3 * found["coarse"]["faces"]
    assert found["closed"]["watertight"] and not found["open"]["watertight"]


@pytest.mark.slow
def test_a_warm_batch_compiles_nothing(work, tmp_path, monkeypatch, capsys):
    """The programs that `warm_up` counts are all that a batch needs."""
    _, manifest = work
    said, traces, align = [], [], _register_many.align_to
    counted = lambda *args: (traces.append(1), align(*args))[1]
    monkeypatch.setattr(_register_many, "align_to", counted)
    assert warm_up(manifest, chunk=4, tell=said.append) == len(said) == 1
    first = len(traces)
    assert first >= 1 and "up to 256 points, 4 at once" in said[0]
    tally = run_batch(manifest, tmp_path / "out", chunk=4)
    assert tally["ok"] == 6 and len(traces) == first
    assert main(["warmup", manifest, "--chunk", "4"]) == 0
    assert "1 programs are in the cache" in capsys.readouterr().out


@pytest.mark.slow
def test_a_full_disk_is_reported_and_leaves_no_half_state(work, tmp_path):
    _, manifest = work
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (64, 64))"
    driver = _driver(manifest, tmp_path / "out", before=limit)
    _, told = driver.communicate(timeout=200)
    assert driver.returncode == 3 and "jaxgeom: error: " in told and "arge" in told
    assert not [p for p in (tmp_path / "out").rglob("*") if p.is_file()]


@pytest.mark.slow
def test_a_killed_driver_goes_on_and_two_drivers_agree(work, tmp_path):
    folder, _ = work
    rows = [(f"k{i}", _good(folder, i), folder / "target.npy") for i in range(24)]
    manifest, out = _write(folder, rows, "many.csv"), tmp_path / "out"
    driver = _driver(manifest, out)
    deadline = time.monotonic() + 200
    while not list(out.glob("status/??/*.json")) and time.monotonic() < deadline:
        time.sleep(0.002)
    os.kill(driver.pid, signal.SIGKILL)
    driver.communicate()
    assert driver.returncode == -signal.SIGKILL
    times = {p: p.stat().st_mtime_ns for p in out.glob("status/??/*.json")}
    assert 0 < len(times) < 24
    pair = [_driver(manifest, out), _driver(manifest, out)]
    for each in pair:
        printed, told = each.communicate(timeout=300)
        assert each.returncode == 0, told
        assert " 0 failed" in printed
    found = _states(out)
    assert sorted(found) == sorted(row[0] for row in rows)
    for i in range(24):
        np.testing.assert_allclose(found[f"k{i}"]["transform"], _motion(i), atol=0.03)
    assert times == {p: p.stat().st_mtime_ns for p in times}


@pytest.mark.slow
@pytest.mark.parametrize("count", [4, 8])
def test_many_devices_equal_one(on_devices, count):
    code = f"""
import sys; sys.path.insert(0, {os.path.dirname(__file__)!r})
import jax, numpy as np
from test_batch import _lumps
from jaxgeom import PointCloud, register_many, stack
scans = [PointCloud(_lumps(200 + i, i) + 0.02) for i in range(6)]
found = register_many(stack(scans), PointCloud(_lumps(250, 99)))
matrix = jax.vmap(lambda t: t.matrix())(found.target_from_source)
assert matrix.shape == (6, 4, 4)
np.savez(sys.argv[1], n=jax.local_device_count(), matrix=matrix,
         fitness=found.fitness, steps=found.num_steps)
"""
    one, many = (on_devices(code, n) for n in (1, count))
    assert one["n"] == 1 and many["n"] == count
    np.testing.assert_array_equal(one["steps"], many["steps"])
    np.testing.assert_allclose(one["matrix"], many["matrix"], atol=1e-6)
    np.testing.assert_allclose(one["fitness"], many["fitness"], atol=1e-6)


@pytest.mark.slow
def test_a_batch_equals_register(work, tmp_path):
    folder, manifest = work
    out = tmp_path / "out"
    main(["batch", manifest, "--out", str(out), "--chunk", "8"])
    target = np.load(folder / "target.npy")
    size = choose_voxel_size(target)
    for i in (1, 4):
        alone = register(np.load(folder / f"s{i}.npy"), target, voxel_size=size)
        matrix = np.asarray(alone.target_from_source.matrix())
        found = _states(out)[f"s{i}"]["transform"]
        np.testing.assert_allclose(found, matrix, atol=1e-3)


@pytest.mark.slow
def test_what_did_not_settle_is_a_warning(work, tmp_path):
    _, manifest = work
    out = tmp_path / "out"
    hasty = Registering(lambda target: {"pyramid": Pyramid(max_steps=3)})
    assert run_batch(manifest, out, registering=hasty, chunk=8)["warning"] > 0
    state = _states(out)["s0"]
    assert (state["status"], state["code"]) == ("warning", "not_converged")
    assert "stopped before" in state["message"]
    np.testing.assert_allclose(state["transform"], _motion(0), atol=0.03)
