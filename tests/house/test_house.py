"""The floors, the names and the top level, proven from the source."""

import ast
import pathlib
import subprocess
import sys

import pytest

import jaxgeom

PACKAGE = pathlib.Path(jaxgeom.__file__).parent
FLOORS = [
    {"_core"},
    {"shapes", "transforms"},
    {"neighbors", "linear"},
    {"fields", "meshes", "parametric", "subdivision", "clouds"},
    {"isosurface", "reconstruction", "registration", "normals", "learning"},
    {"pipelines", "convert"},
    {"io", "render"},
    {"batch"},
    {"cli"},
]
# Nouns know only nouns: a transform moves clouds and meshes, so shapes lie below it.
BELOW = {"transforms": {"shapes"}}
FILES = sorted(p for p in PACKAGE.rglob("*.py") if p.parent != PACKAGE)


def _floor(room):
    return next(i for i, rooms in enumerate(FLOORS) if room in rooms)


def _rooms_imported(path):
    depth = len(path.relative_to(PACKAGE).parts)
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == depth and node.module:
            yield node.module.split(".")[0]


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_point_down(path):
    room = path.relative_to(PACKAGE).parts[0]
    for other in _rooms_imported(path):
        lower = _floor(other) < _floor(room)
        assert lower or other == room or other in BELOW.get(room, set()), (room, other)


def test_every_room_has_a_floor():
    rooms = {p.name for p in PACKAGE.iterdir() if (p / "__init__.py").exists()}
    assert rooms == set().union(*FLOORS)


def test_trimesh_stays_on_the_street():
    for path in FILES:
        if path.relative_to(PACKAGE).parts[0] in {"io", "render"}:
            continue
        names = [
            alias.name
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Import)
            for alias in node.names
        ]
        assert "trimesh" not in names, path


def test_only_the_command_line_sets_global_state():
    for path in FILES:
        if path.relative_to(PACKAGE).parts[0] != "cli":
            assert "config.update" not in path.read_text(), path


@pytest.mark.parametrize("path", FILES, ids=lambda p: str(p.relative_to(PACKAGE)))
def test_public_names_have_docstrings(path):
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree), path
    for node in tree.body:
        named = isinstance(node, ast.FunctionDef | ast.ClassDef)
        if named and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{path}: {node.name}"


def test_top_level_is_as_fixed():
    top = PACKAGE.parent
    if not (top / "pyproject.toml").exists():
        pytest.skip("the package is tested away from its source tree")
    names = {p.name for p in top.iterdir() if not p.name.startswith(".")}
    allowed = {"pyproject.toml", "jaxgeom", "tests", "experiments", "README.md"}
    assert names - {"demo", "build", "dist"} <= allowed


def test_import_and_help_do_not_start_jax():
    code = (
        "import sys, jaxgeom; from jaxgeom.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "assert 'jax' not in sys.modules and 'trimesh' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_all_public_names_exist():
    for name in jaxgeom.__all__:
        assert getattr(jaxgeom, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = jaxgeom.nonsense
