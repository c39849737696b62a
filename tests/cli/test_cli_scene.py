"""Fields of a user's script: meshes, pictures, and what can be wrong with them."""

import json

import numpy as np
import pytest

from jaxgeom.cli import main
from jaxgeom.io import load_mesh

SCRIPT = """
import jax.numpy as jnp
from jaxgeom.fields import Sphere
ball = Sphere(0.7, [0.1, 0.2, 0.3])
def egg(p):
    return jnp.linalg.norm(p / jnp.array([1.0, 0.8, 1.3])) - 1
wrong = lambda p: p
"""
BOX = "--bounds=-1.2,1.2,-1,1,-1.5,1.5"


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.py"
    path.write_text(SCRIPT)
    return path


def test_a_field_knows_its_box_and_becomes_a_mesh(scene, tmp_path, capsys):
    mesh, report = tmp_path / "ball.ply", tmp_path / "ball.json"
    arguments = ["mesh", f"{scene}:ball", "-o", str(mesh), "--resolution", "24"]
    assert main([*arguments, "--report", str(report)]) == 0
    assert "watertight" in capsys.readouterr().out
    vertices = np.asarray(load_mesh(mesh).vertices)
    gaps = np.linalg.norm(vertices - [0.1, 0.2, 0.3], axis=1) - 0.7
    assert np.abs(gaps).max() < 0.01
    facts = json.loads(report.read_text())
    assert facts["result"]["watertight"] and facts["result"]["euler"] == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        ("--resolution", "257"),
        ("--method", "dual-contouring", "--tolerance", "0.02"),
        ("--method", "dual-grid", "--tolerance", "0.02"),
        ("--method", "dual-grid"),
    ],
    ids=["bricks", "octree", "dual grid octree", "dual grid"],
)
def test_methods_and_sizes_of_meshes(scene, tmp_path, options):
    mesh, report = tmp_path / "ball.ply", tmp_path / "ball.json"
    arguments = ["mesh", f"{scene}:ball", "-o", str(mesh), "--resolution", "40"]
    assert main([*arguments, "--report", str(report), *options]) == 0
    vertices = np.asarray(load_mesh(mesh).vertices)
    gaps = np.linalg.norm(vertices - [0.1, 0.2, 0.3], axis=1) - 0.7
    assert np.abs(gaps).max() < 0.04
    facts = json.loads(report.read_text())
    assert facts["result"]["watertight"] and facts["result"]["euler"] == 2


def test_a_callable_needs_a_box(scene, tmp_path, capsys):
    mesh = tmp_path / "egg.ply"
    arguments = ["mesh", f"{scene}:egg", "-o", str(mesh), "--resolution", "24"]
    assert main(arguments) == 4
    assert "--bounds" in capsys.readouterr().err and not mesh.exists()
    assert main([*arguments, BOX]) == 0
    span = np.ptp(np.asarray(load_mesh(mesh).vertices), axis=0)
    np.testing.assert_allclose(span, [2.0, 1.6, 2.6], atol=0.05)
    empty = [*arguments, "--bounds=4,5,4,5,4,5"]
    assert main(empty) == 5 and "no surface" in capsys.readouterr().out


def test_a_field_is_drawn(scene, tmp_path):
    picture = tmp_path / "egg.png"
    arguments = ["render", f"{scene}:egg", "-o", str(picture), "--size", "40", BOX]
    assert main(arguments) == 0
    assert picture.read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(
    "name, code, words",
    [
        ("scene.py:wrong", 4, "one number"),
        ("scene.py:absent", 4, "ball, egg"),
        ("missing.py:ball", 3, "no such file"),
        ("broken.py:ball", 3, "ZeroDivisionError: division by zero (line 1"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(scene, capsys, name, code, words):
    (scene.parent / "broken.py").write_text("1 / 0")
    where = str(scene.parent / name)
    assert main(["mesh", where, "-o", "never.ply"]) == code
    text = capsys.readouterr().err
    assert words in text and "Traceback" not in text and text.count("\n") == 1


@pytest.mark.parametrize("box", ["1,2,3", "1,0,0,1,0,1", "a,b,c,d,e,f"])
def test_boxes_of_another_form_are_usage_errors(scene, box, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["mesh", f"{scene}:ball", "-o", "never.ply", f"--bounds={box}"])
    assert stop.value.code == 2 and "six numbers" in capsys.readouterr().err
