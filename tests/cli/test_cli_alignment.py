"""The commands that align scans: what they print, write and return."""

import json

import numpy as np
import pytest

from jaxgeom import PointCloud
from jaxgeom.cli import main
from jaxgeom.io import load_cloud, load_mesh, save_cloud


def _lumps(count, seed=0):
    """Points on a closed surface without symmetries."""
    d = np.random.default_rng(seed).normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    x, y, z = d.T
    waves = 0.15 * np.sin(3 * x + 1) * np.cos(4 * y) + 0.1 * np.sin(5 * z + 2 * x)
    return d * (1 + 0.2 * x + waves)[:, None]


def _motion(angle=0.15):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    return turn, np.array([0.05, -0.08, 0.1])


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A target, a moved sample of the same surface, and one far from it."""
    folder = tmp_path_factory.mktemp("scans")
    turn, shift = _motion()
    target, source = _lumps(4000), _lumps(3900, seed=1)
    back = (source - shift) @ turn  # the inverse of x -> R x + t
    save_cloud(folder / "target.ply", PointCloud(target))
    save_cloud(folder / "source.ply", PointCloud(back))
    save_cloud(folder / "away.ply", PointCloud(back + 1000.0))
    return folder


@pytest.mark.slow
def test_register_prints_and_writes_the_motion(files, tmp_path, capsys):
    moved, report = tmp_path / "moved.ply", tmp_path / "report.json"
    arguments = ["register", str(files / "source.ply"), str(files / "target.ply")]
    assert main([*arguments, "-o", str(moved), "--report", str(report)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("T_target_source\n")
    facts = json.loads(report.read_text())["result"]
    printed = np.array([line.split() for line in out.splitlines()[1:5]], float)
    np.testing.assert_allclose(printed, facts["T_target_source"], rtol=1e-6, atol=1e-8)
    turn, shift = _motion()
    np.testing.assert_allclose(printed[:3, :3], turn, atol=5e-3)
    np.testing.assert_allclose(printed[:3, 3], shift, atol=5e-3)
    assert facts["status"] == "ok" and facts["fitness"] > 0.9
    expected = load_cloud(files / "source.ply").points @ printed[:3, :3].T
    np.testing.assert_allclose(
        load_cloud(moved).points, expected + printed[:3, 3], atol=1e-6
    )


@pytest.mark.slow
def test_scans_apart_exit_with_5_and_write_nothing(files, tmp_path, capsys):
    moved = tmp_path / "moved.ply"
    arguments = ["register", str(files / "away.ply"), str(files / "target.ply")]
    assert main([*arguments, "-o", str(moved)]) == 5
    assert "alignment:" in capsys.readouterr().err
    assert not moved.exists()


def test_a_start_must_be_a_rigid_matrix(files, tmp_path, capsys):
    arguments = ["register", str(files / "source.ply"), str(files / "target.ply")]
    for rows in (np.eye(3), 2 * np.eye(4), np.diag([1.0, 1, -1, 1])):
        path = tmp_path / "start.txt"
        np.savetxt(path, rows)
        assert main([*arguments, "--init", str(path)]) == 4
        assert "must hold a rigid motion" in capsys.readouterr().err
    path.write_text("not numbers\n")
    assert main([*arguments, "--init", str(path)]) == 4
    assert "must hold a rigid motion" in capsys.readouterr().err


@pytest.mark.parametrize("distance", ["-1", "x", "0%"])
def test_distances_are_lengths_or_percentages(distance):
    with pytest.raises(SystemExit) as caught:
        main(["register", "a", "b", "--max-correspondence-distance", distance])
    assert caught.value.code == 2


@pytest.mark.slow
def test_global_start_and_many(files, tmp_path, capsys):
    source, target = str(files / "source.ply"), str(files / "target.ply")
    assert main(["register", source, target, "--global"]) == 0
    report = tmp_path / "report.json"
    many = ["register-many", target, source, str(files / "away.ply"), source]
    assert main([*many, "--report", str(report)]) == 5
    facts = json.loads(report.read_text())["result"]
    assert facts[source]["status"] == "ok"
    assert facts[str(files / "away.ply")]["status"] != "ok"
    turn, _ = _motion()
    matrix = np.array(facts[source]["T_target_source"])
    np.testing.assert_allclose(matrix[:3, :3], turn, atol=5e-3)


@pytest.mark.slow
def test_fuse_makes_one_mesh_of_real_scans(data, tmp_path, capsys):
    folder = data / "registration" / "stanford_bunny"
    names = ("bun000", "bun045", "bun315", "top3", "bun270")
    scans = [str(folder / f"{name}.ply.gz") for name in names]
    mesh, poses = tmp_path / "bunny.ply", tmp_path / "poses.json"
    arguments = ["fuse", *scans, "-o", str(mesh), "--poses", str(poses)]
    assert main([*arguments, "--viewpoint", "0", "0", "10", "--depth", "6"]) == 0
    assert "watertight" in capsys.readouterr().out
    found = json.loads(poses.read_text())["T_world_scan"]
    np.testing.assert_allclose(found[scans[0]], np.eye(4), atol=1e-6)
    # bun.conf: 045 is turned by 34.3 degrees against 000.
    turn = np.array(found[scans[1]])[:3, :3]
    angle = np.degrees(np.arccos((np.trace(turn) - 1) / 2))
    assert angle == pytest.approx(34.3, abs=0.5)
    assert len(load_mesh(mesh).faces) > 5000
