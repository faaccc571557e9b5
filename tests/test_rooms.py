"""The arrows between the packages point one way."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "rbfevo"
# What each room may import, beside itself and the plain modules at the top.
PLAIN = {"arrays", "choices", "errors", "files", "names"}
ROOMS = {
    "geometry": set(),
    "meshes": set(),
    "scenarios": {"geometry", "meshes"},
    "scoring": {"geometry", "scenarios"},
    "methods": {"geometry", "scenarios", "scoring"},
    "advice": {"scenarios", "scoring", "methods"},
    "recorded": {"geometry", "scoring"},
    "runs": {"geometry", "scenarios", "scoring", "methods", "figures"},  # a run starts the program that draws
    "descent": {"geometry", "scenarios", "scoring", "recorded"},
    "fit": {"scenarios", "scoring", "methods", "runs", "recorded"},
    "figures": {"recorded"},
    "commands": {"geometry", "meshes", "scenarios", "scoring", "descent", "runs", "recorded", "figures"},
    "studio": {"geometry", "meshes", "scenarios", "scoring", "methods", "runs", "recorded", "commands"},
}


def imports(path: Path) -> Iterator[str]:
    """The rooms and plain modules of rbfevo that a module imports."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "rbfevo":
            below = (node.module or "").split(".")[1:]
            yield from [below[0]] if below else [alias.name for alias in node.names]


@pytest.mark.parametrize("room", ROOMS)
def test_imports_run_one_way(room: str) -> None:
    wrong = [
        (str(path.relative_to(PACKAGE)), name)
        for path in sorted((PACKAGE / room).rglob("*.py"))
        if path.name != "__main__.py"  # a command, which may use all
        for name in imports(path)
        if name not in ROOMS[room] | {room} | PLAIN
    ]
    assert wrong == []


def test_every_package_is_a_room() -> None:
    assert {path.parent.name for path in PACKAGE.glob("*/__init__.py")} == set(ROOMS)


def test_every_package_is_installed() -> None:
    """Setuptools takes the packages that pyproject.toml lists."""
    listed = set(tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {".".join(path.parent.relative_to(PACKAGE.parent).parts) for path in PACKAGE.rglob("__init__.py")}
    assert listed == found | {"rbfevo.conf"}


def test_the_plain_modules_at_the_top_import_no_room() -> None:
    assert {name for module in PLAIN for name in imports(PACKAGE / f"{module}.py")} <= PLAIN
