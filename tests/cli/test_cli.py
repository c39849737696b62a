"""The command line: exit codes, messages, files, the report."""

import json
import time

import numpy as np
import pytest

from jaxgeom import PointCloud
from jaxgeom.cli import _reconstruct, _report, main
from jaxgeom.io import load_mesh, save_cloud, save_mesh
from jaxgeom.meshes import icosphere


@pytest.fixture
def egg(tmp_path):
    p = np.random.default_rng(0).normal(size=(3000, 3))
    p /= np.linalg.norm(p, axis=1, keepdims=True)
    path = tmp_path / "egg.ply"
    save_cloud(path, PointCloud(p * [1.0, 0.8, 1.3], p / [1.0, 0.8, 1.3]))
    return path


def test_reconstruct_writes_mesh_and_report(egg, tmp_path, capsys):
    mesh, report = tmp_path / "mesh.ply", tmp_path / "report.json"
    arguments = ["reconstruct", str(egg), "-o", str(mesh), "--depth", "5"]
    assert main([*arguments, "--report", str(report)]) == 0
    assert "watertight" in capsys.readouterr().out
    facts = json.loads(report.read_text())
    assert facts["status"] == "ok" and facts["parameters"]["resolution"] == 32
    assert facts["result"]["watertight"] and facts["parameters"]["screening"] > 0
    assert len(load_mesh(mesh).faces) == facts["result"]["faces"]


def test_info_tells_what_a_file_holds(egg, capsys):
    assert main(["info", str(egg)]) == 0
    out = capsys.readouterr().out
    assert "3000 points" in out and "normals" in out and "GiB" in out


@pytest.mark.parametrize(
    "arguments, code, words",
    [
        (["reconstruct", "missing.ply", "-o", "out.ply"], 3, "missing.ply"),
        (["info", "missing.ply"], 3, "missing.ply"),
    ],
)
def test_missing_files_exit_with_3(arguments, code, words, capsys):
    assert main(arguments) == code
    assert words in capsys.readouterr().err


def test_bad_data_exit_with_4_and_write_nothing(tmp_path, capsys):
    path, out = tmp_path / "three.xyz", tmp_path / "out.ply"
    path.write_text("0 0 0\n1 0 0\n0 1 0\n")
    assert main(["reconstruct", str(path), "-o", str(out)]) == 4
    text = capsys.readouterr().err
    assert "at least 4 points" in text and "Traceback" not in text
    assert not out.exists()


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["reconstruct"],
        ["reconstruct", "a.ply", "-o", "b.ply", "--resolution", "x"],
        ["reconstruct", "a.ply", "-o", "b.ply", "--depth", "7", "--resolution", "9"],
        ["reconstruct", "a.ply", "-o", "b.ply", "--scale", "0.5"],
    ],
)
def test_usage_errors_exit_with_2(arguments):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2


def _reconstruct_with(monkeypatch, replacement):
    monkeypatch.setattr(_reconstruct, "reconstruct", replacement)


def test_a_mesh_with_a_hole_exits_with_5(egg, tmp_path, capsys, monkeypatch):
    whole = _reconstruct.reconstruct

    def holed(cloud, **settings):
        settings["trim"] = 1.05  # removes about half of the surface
        return whole(cloud, **settings)

    _reconstruct_with(monkeypatch, holed)
    mesh, report = tmp_path / "mesh.ply", tmp_path / "report.json"
    arguments = ["reconstruct", str(egg), "-o", str(mesh), "--depth", "5"]
    assert main([*arguments, "--report", str(report)]) == 5
    assert "open" in capsys.readouterr().out
    assert json.loads(report.read_text())["status"] == "failed its check"


def test_interruption_exits_with_130(egg, tmp_path, capsys, monkeypatch):
    def interrupted(cloud, **settings):
        raise KeyboardInterrupt

    _reconstruct_with(monkeypatch, interrupted)
    assert main(["reconstruct", str(egg), "-o", str(tmp_path / "mesh.ply")]) == 130
    assert "interrupted" in capsys.readouterr().err
    assert not (tmp_path / "mesh.ply").exists()


def test_long_stages_say_so_while_they_run(capsys, monkeypatch):
    monkeypatch.setattr(_report, "_PATIENCE", 0.05)
    stages = _report.Stages()
    with stages.stage("solve"):
        time.sleep(0.5)
        assert "solve ..." in capsys.readouterr().err
    assert f"solve: {stages.seconds['solve']:.1f} s" in capsys.readouterr().err
    monkeypatch.setattr(_report, "_PATIENCE", 60.0)
    with stages.stage("write"):
        pass
    assert capsys.readouterr().err == ""


def test_pictures_and_pages_of_meshes_and_clouds(egg, tmp_path, capsys):
    ball = tmp_path / "ball.ply"
    save_mesh(ball, icosphere(2))
    for source in (egg, ball):
        png, page = tmp_path / "a.png", tmp_path / "a.html"
        assert main(["render", str(source), "-o", str(png), "--size", "64"]) == 0
        assert main(["view", str(source), "-o", str(page)]) == 0
        assert png.read_bytes().startswith(b"\x89PNG")
        assert b"<html" in page.read_bytes().lower()
    assert main(["info", str(ball)]) == 0
    assert "320 faces, watertight, 1 bodies" in capsys.readouterr().out
