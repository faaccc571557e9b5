"""Whole runs with several objectives: on a slab, interrupted, drawn, in a sweep, and with files that do not fit."""

from __future__ import annotations

import csv
import json
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv

from rbfevo import collect, export
from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.figures import centers, front
from rbfevo.recorded.picks import pick
from rbfevo.recorded.record import Record, read
from rbfevo.runs import run
from rbfevo.runs.journal import Journal
from tests import several
from tests.slabs import saved, strip
from tests.test_contracts import option, settings

SEARCHES = ("cmaes", "gradient", "nsga2")


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return several.eggs(tmp_path_factory.mktemp("egg"))


@pytest.fixture(scope="module")
def directory(template: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    out = tmp_path_factory.mktemp("found") / "run"
    several.searched(out, template, "method=nsga2", "method.population=16", "method.generations=3")
    return out


@pytest.fixture(scope="module")
def found(directory: Path) -> Record:
    return read(directory)


@pytest.mark.parametrize("norm", [2, 16])
def test_on_a_slab_each_objective_counts_in_its_plane_alone(norm: int, tmp_path: Path) -> None:
    x, y = np.tile(strip_places(), (2, 1)).T
    s = np.stack([np.exp(-((x - 1.0) ** 2)), y, 0.0 * x], axis=1)
    lift = np.stack([np.sin(x), np.cos(2.0 * y), 0.0 * x], axis=1)
    slab = saved(strip(64), tmp_path / "slab.vtp", s=s, lift=lift)
    more = [f"scenario.template={slab}", "scenario.sensitivity=[s,lift]", "scenario.planar=z", "method=ols"]
    more += ["method.per_axis=6", "quiet=true", "centers=4", "figures=false", "kernel.support=1.2"]
    more += [f"criterion.norm={norm}", "scenario.combine=worst"]
    assert main(["scenario=mesh", *more, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    record = read(tmp_path / "run")
    assert record.gradients is not None
    assert record.potentials is not None
    assert record.objectives == ("s", "lift")
    assert not record.gradients[..., 2].any()
    roots = np.sqrt(record.weights)[:, None]
    for row, C in enumerate(record.centers):
        r = np.linalg.norm(record.vertices[:, None] - C, axis=2) / 1.2
        U = roots * np.where(r < 1, (1 - r) ** 4 * (4 * r + 1), 0)
        for index, g in enumerate(record.gradients):
            left = roots * g - U @ np.linalg.lstsq(U, roots * g, rcond=None)[0]
            assert record.potentials[row, index] == pytest.approx(1.0 - float((left**2).sum()), abs=1e-9)
    assert record.worst_potential is not None
    each = record.potentials if norm == 2 else record.bounded_potentials
    assert each is not None
    np.testing.assert_allclose(record.worst_potential, each.min(1), atol=1e-12)


def strip_places() -> np.ndarray:
    from tests.slabs import ring

    return ring(64)


@pytest.mark.parametrize("combine", ["mean", "worst"])
@pytest.mark.parametrize("method", SEARCHES)
def test_an_interrupted_search_goes_on_to_the_same_setups(
    method: str, combine: str, template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = {**option("scenario", "mesh"), "template": str(template), "sensitivity": several.sources(template)}
    node |= {"combine": combine, "support": several.SUPPORT}
    asked = settings(method, scenario=node, centers=3)
    assert run.carry_out(asked, tmp_path / "whole") == 0
    write_lines = Journal.record

    def record_and_interrupt(journal: Journal, lines: Any) -> None:
        write_lines(journal, lines)
        signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "record", record_and_interrupt)
        assert run.carry_out(asked, tmp_path / "broken") == 143
    partial = read(tmp_path / "broken")
    assert partial.potentials is not None
    assert partial.potentials.shape == (len(partial.centers), 2)
    assert run.carry_out(asked, tmp_path / "broken", resume=True) == 0
    whole, broken = read(tmp_path / "whole"), read(tmp_path / "broken")
    np.testing.assert_array_equal(whole.centers, broken.centers)
    np.testing.assert_array_equal(whole.potentials, broken.potentials)
    assert (whole.worst_potential is None) == (combine == "mean")
    np.testing.assert_array_equal(whole.potential, broken.potential)


def test_pictures_have_rows_for_each_objective(found: Record) -> None:
    image = centers.picture(found, opengl=False)
    labels = [text.get_text() for text in image.texts]
    for name in ("s", "lift"):
        assert any(label.startswith(f"{name}:\nwanted") for label in labels)
        assert any(label.startswith(f"{name}:\nresidual") for label in labels)
    assert "mean improvement potential" in front.picture(found).axes[0].get_ylabel()


def test_a_sweep_over_the_combination_keeps_what_is_not_comparable_apart(template: Path, tmp_path: Path) -> None:
    listed = ",".join(several.sources(template))
    fixed = ["scenario=mesh", f"scenario.template={template}", f"scenario.sensitivity=[{listed}]", "quiet=true"]
    fixed += ["figures=false", "centers=3", f"kernel.support={several.SUPPORT}", "method=random", "seed=1,2"]
    fixed += ["method.population=6", "scenario.combine=mean,worst", f"hydra.sweep.dir={tmp_path / 'sweep'}", "-m"]
    assert main(fixed) == 0
    assert collect.main([str(tmp_path / "sweep")]) == 0
    with (tmp_path / "sweep" / "medians.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["series"] == "random"]
    assert len(rows) == 2
    assert len({row["mesh"] for row in rows}) == 2  # never one group
    assert all(row["seeds"] == "2" for row in rows)
    page = (tmp_path / "sweep" / "report.html").read_text()
    assert "minimum improvement potential" in page
    assert "mean improvement potential" in page


def test_a_pick_and_its_export_are_of_what_was_searched(
    found: Record, directory: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    row = pick(found, "best-improvement-potential")
    assert found.potentials is not None
    assert row == found.usable[found.potentials[found.usable].mean(1).argmax()]
    asked = [str(directory), "--pick", f"index:{row}", "--step", "0.02", "--objective", "lift"]
    assert export.main([*asked, "--out", str(tmp_path / "lift")]) == 0
    printed = capsys.readouterr().out
    assert "predicted change of s:" in printed
    template: Any = pv.read(tmp_path / "lift" / "template.vtp")
    lift = np.load(Path(found.summary["sensitivities"][1]["source"]))
    value = float((lift * template["reached"]).sum())
    assert f"predicted change of lift: {value:.4g}" in printed


def removed(name: str) -> Callable[[dict[str, Any]], None]:
    return lambda arrays: arrays.pop(name)


def cut(name: str, axis: int) -> Callable[[dict[str, Any]], None]:
    def change(arrays: dict[str, Any]) -> None:
        arrays[name] = np.delete(arrays[name], 0, axis)

    return change


@pytest.mark.parametrize(
    ("file", "change"),
    [
        ("setups.npz", removed("potentials")),
        ("setups.npz", cut("potentials", 1)),
        ("setups.npz", cut("potentials", 0)),
        ("scenario.npz", removed("gradients")),
        ("scenario.npz", cut("gradients", 0)),
        ("scenario.npz", cut("gradients", 1)),
        ("scenario.npz", cut("gradient", 1)),
        ("summary.json", removed("sensitivities")),
        ("summary.json", lambda summary: summary["sensitivities"].pop()),
        ("summary.json", lambda summary: summary["sensitivities"][0].pop("name")),
        ("summary.json", lambda summary: summary.update(sensitivities=3)),
    ],
)
def test_files_that_do_not_fit_get_one_line(
    file: str, change: Callable[[dict[str, Any]], None], directory: Path, tmp_path: Path
) -> None:
    shutil.copytree(directory, tmp_path / "run")
    path = tmp_path / "run" / file
    if file.endswith("npz"):
        with np.load(path) as held:
            arrays = dict(held)
        change(arrays)
        np.savez(path, **arrays)
    else:
        summary = json.loads(path.read_text())
        change(summary)
        path.write_text(json.dumps(summary))
    with pytest.raises(UserError, match="do not match; restore the files of one run"):
        read(tmp_path / "run")


@pytest.mark.parametrize("norm", [2, 16])
def test_the_nested_sequence_has_the_least_potential_where_that_is_searched(
    norm: int, template: Path, tmp_path: Path
) -> None:
    common = ["scenario.combine=worst", f"criterion.norm={norm}", "method.per_axis=6"]
    record = several.searched(tmp_path / "ols" / "0", template, "method=ols", *common)
    with (tmp_path / "ols" / "0" / "sequence.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5
    assert record.gradients is not None
    centers_of = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    for m, row in enumerate(rows, 1):
        each = [several.plain_potential(record, g, centers_of[:m]) for g in record.gradients]
        assert float(row["improvement_potential"]) == pytest.approx(np.mean(each), abs=1e-9)
        if norm == 2:
            assert float(row["worst_potential"]) == pytest.approx(min(each), abs=1e-9)
    assert record.worst_potential is not None
    assert float(rows[-1]["worst_potential"]) == pytest.approx(record.worst_potential[0], abs=1e-6)
    worst = [float(row["worst_potential"]) for row in rows]
    assert (np.diff(worst) >= -1e-9).all()
    if norm == 16:
        assert record.bounded_potential is not None
        assert float(rows[-1]["bounded_potential"]) == pytest.approx(record.bounded_potential[0], abs=1e-6)
        return
    for count in (2, 4):  # a sweep takes the sequence that the run has left
        several.searched(tmp_path / "ols" / str(count), template, "method=lloyd", f"centers={count}", *common[:2])
    assert collect.main([str(tmp_path / "ols"), "--sequence", "5"]) == 0
    with (tmp_path / "ols" / "sequence.csv").open() as file:
        collected = list(csv.DictReader(file))
    assert [float(row["worst_potential"]) for row in collected[:5]] == worst
