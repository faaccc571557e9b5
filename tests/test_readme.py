"""What the README shows works as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
LIBRARY = (ROOT / "docs" / "library.md").read_text()
ARCHITECTURE = (ROOT / "docs" / "architecture.md").read_text()


def test_the_library_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", LIBRARY, re.DOTALL)
    assert len(code.strip().splitlines()) <= 14
    smaller = code.replace("plane()", "plane((30, 30))").replace("range(200)", "range(3)")
    assert smaller != code
    exec(compile(smaller, "library.md", "exec"), {})
    assert "tensor" in capsys.readouterr().out


def test_every_path_that_it_names_exists() -> None:
    for path in re.findall(r"\]\(([^)#]+)\)", README) + re.findall(r"`(scripts/\w+|tests/\w+\.py)", README):
        if not path.startswith("http"):
            assert (ROOT / path).exists(), path


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= 130


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda page: page.name)
def test_every_path_that_the_docs_name_exists(page: Path) -> None:
    for path in re.findall(r"\]\(([^)#]+)\)", page.read_text()):
        if not path.startswith("http"):
            assert (page.parent / path).exists(), path


def test_the_map_names_every_package_and_command() -> None:
    (tree,) = re.findall(r"```\n(conf/.*?)```", ARCHITECTURE, re.DOTALL)
    packages = {path.parent.name for path in (ROOT / "rbfevo").glob("*/__init__.py")}
    assert {name for name in packages if f"{name}/" not in tree} == set()
    commands = {path.stem for path in (ROOT / "rbfevo").glob("*.py") if 'if __name__ == "__main__"' in path.read_text()}
    assert {name for name in commands - {"__main__"} if name not in tree} == set()
