"""The README's Python runs, in order, as one script."""

import pathlib
import re

import pytest

README = pathlib.Path(__file__).parents[2] / "README.md"


def test_code_blocks_run(capsys):
    if not README.exists():
        pytest.skip("the package is tested away from its source tree")
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) >= 2
    names = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), names)
    assert abs(float(names["value"]) / (4 / 3 * 3.14159265 * 1.5**3) - 1) < 0.03
    assert abs(float(names["slope"]) / (4 * 3.14159265 * 1.5**2) - 1) < 0.03
    assert "True True ()\n" in capsys.readouterr().out
    found, moved = names["found"], names["moved"]
    gap = found.target_from_source.matrix() - moved.matrix()
    assert float(abs(gap).max()) < 1e-3
