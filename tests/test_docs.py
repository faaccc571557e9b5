"""The guides: their commands run, on a coarser body and a shorter search; their tables are those on disk."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
from called import line
from matplotlib.image import imread

from benchmarks import choosing

ROOT = Path(__file__).parents[1]
SHORT = {
    "rbfevo": ["method.starts=16", "method.population=16", "method.generations=10", "method.polish=3", "method.front=8",
               "figures=false"],
    "docs/car/body.py": ["--spacing", "0.12"],
}  # fmt: skip


def commands() -> list[list[str]]:
    text = (ROOT / "docs" / "car.md").read_text()
    (block,) = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    return [shlex.split(line) for line in block.replace("\\\n", " ").strip().splitlines()]


def test_the_five_commands_lower_the_drag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lines = commands()
    assert len(lines) == 5
    outputs = []
    for arguments in lines:
        program = arguments[2] if arguments[1] == "-m" else arguments[1]
        more = SHORT.get(program, []) if "--drag" not in arguments else []
        arguments = [str(ROOT / word) if word == "docs/car/body.py" else word for word in [*arguments[1:], *more]]
        done = line(arguments)
        assert done.returncode == 0, done.stderr
        outputs.append(done.stdout)
    before, after = (float(re.findall(r"J = ([\d.]+)", text)[0]) for text in (outputs[0], outputs[-1]))
    assert after < 0.95 * before
    template, deformed = (pv.read(tmp_path / "outputs" / "car" / f"{name}.vtp") for name in ("car", "deformed"))
    moved = np.linalg.norm(np.asarray(deformed.points) - np.asarray(template.points), axis=1)
    diagonal = np.linalg.norm(np.ptp(np.asarray(template.points), axis=0))
    assert moved.max() == pytest.approx(0.02 * diagonal, rel=1e-3)
    assert "drag_sensitivity" in deformed.point_data
    flipped = np.asarray(deformed.points) * (1, -1, 1)  # still symmetric
    nearest = np.linalg.norm(np.asarray(deformed.points)[:, None] - flipped[None, ::50], axis=2).min(axis=0)
    assert nearest.max() < 1e-6


def test_the_tables_of_the_page_are_those_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "choosing.md"
    page.write_text((ROOT / "docs" / "choosing.md").read_text())
    monkeypatch.setattr(choosing, "PAGE", page)
    monkeypatch.setattr(sys, "argv", ["choosing", "--page"])
    assert choosing.main() == 0
    assert page.read_text() == (ROOT / "docs" / "choosing.md").read_text()
    assert "| wendland 15% | direct |" in page.read_text()


def test_the_picture_of_both_norms_is_made_by_the_commands_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "docs" / "criterion.md").read_text(), re.DOTALL)
    (block,) = [found for found in blocks if "docs/car/norms.py" in found]
    done = []
    for words in map(shlex.split, block.replace("\\\n", " ").strip().splitlines()):
        words = words[1:]
        more = SHORT.get(words[1] if words[0] == "-m" else words[0], [])
        more = (
            [*more, "centers=12", "method.generations=5", "method.polish=1"] if "criterion.norm=16" in words else more
        )
        arguments = [str(ROOT / word) if word.startswith("docs/car/") else word for word in [*words, *more]]
        # The last one draws with OpenGL, which may end a process.
        drawn = [sys.executable, *arguments]
        picture = words[0].endswith("norms.py")
        done.append(subprocess.run(drawn, capture_output=True, text=True, check=False) if picture else line(arguments))
        assert done[-1].returncode == 0, done[-1].stderr
    names = ("norm", "potential", "saved", "drag", "predicted", "wide")
    numbers = [re.findall(r"-?\d+(?:\.\d+)?", line)[:6] for line in done[-1].stdout.splitlines()]
    two, sixteen = [dict(zip(names, map(float, found), strict=True)) for found in numbers]
    assert (two["norm"], sixteen["norm"]) == (2, 16)
    assert [found["potential"] for found in (two, sixteen)] == [found["saved"] for found in (two, sixteen)]
    assert sixteen["predicted"] < two["predicted"] < 0
    assert max(two["drag"], sixteen["drag"]) < 0
    assert sixteen["wide"] > two["wide"]
    assert imread(tmp_path / "outputs" / "car" / "criterion-car.png").std() > 0.05
