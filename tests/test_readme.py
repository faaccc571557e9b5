"""What the README shows works as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


def test_the_library_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert len(code.strip().splitlines()) <= 14
    smaller = code.replace("plane()", "plane((30, 30))").replace("range(200)", "range(3)")
    assert smaller != code
    exec(compile(smaller, "README.md", "exec"), {})
    assert "tensor" in capsys.readouterr().out


def test_every_path_that_it_names_exists() -> None:
    for path in re.findall(r"\]\(([^)#]+)\)", README) + re.findall(r"`(scripts/\w+|tests/\w+\.py)", README):
        if not path.startswith("http"):
            assert (ROOT / path).exists(), path


def test_the_map_names_every_module() -> None:
    (tree,) = re.findall(r"```\n(conf/.*?)```", README, re.DOTALL)
    modules = {path.name for path in (ROOT / "rbfevo").glob("*.py")} - {"__init__.py", "errors.py"}
    assert {name for name in modules if name not in tree} == set()
