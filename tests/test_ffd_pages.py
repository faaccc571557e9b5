"""Pictures, pages and fits of free-form deformation."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from browsers import opened, settled
from test_ffd import SMALL, pygem
from test_ffd_manipulations import symmetric
from test_mesh_runs import egg

from rbfevo import show
from rbfevo.__main__ import main
from rbfevo.figures import __main__ as figures
from rbfevo.figures import processes
from rbfevo.figures.scene import Fields
from rbfevo.fit import __main__ as fitting
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import setup

if TYPE_CHECKING:
    from playwright.sync_api import Browser

SEARCH = ["method=nsga2", "method.population=12", "method.generations=3"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on the plane, one by points on the surface, and both of a symmetric egg."""
    place = tmp_path_factory.mktemp("runs")
    template = egg(place, subdivisions=2)
    for name, keys in (
        ("indirect", [*SMALL, "representation.lattice=[4,3]"]),
        ("direct", [*SMALL, "representation.lattice=[4,3]", "manipulation=direct", "centers=6"]),
        ("symmetric", symmetric(template)),
        ("both", [*symmetric(template), "manipulation=direct", "centers=7"]),
    ):
        assert main([*keys, *SEARCH, f"hydra.run.dir={place / name}"]) == 0
    return place


def best(record: Record) -> int:
    return int(np.argmax(np.where(record.regularity > 0, record.improvement_potential, -1.0)))


@pytest.mark.parametrize("name", ["direct", "symmetric"])
def test_pages_embed_what_setups_leave_and_pictures_are_drawn(name: str, runs: Path) -> None:
    for figure in ("front", "report"):
        assert figures.main([str(runs / name), "--only", figure]) == 0
    assert processes.draw_one(runs / name, "centers") == (0, None)  # OpenGL may end a process
    assert {"front.png", "centers.png", "report.html"} <= {path.name for path in (runs / name).iterdir()}
    page = (runs / name / "report.html").read_text(encoding="utf-8")
    (content,) = re.findall(r'<script type="application/json" id="content">(.*?)</script>', page, re.DOTALL)
    entry, record = json.loads(content)["runs"][0], read(runs / name)
    assert entry["representation"] == "ffd"
    assert entry["title"].startswith(
        "plane · representation ffd, lattice 4 x 3 · "
        if len(name) > 5 and name != "symmetric"
        else "mesh · representation ffd, lattice 3 x 5 x 2 · "
    )
    left = np.frombuffer(base64.b64decode(entry["embedded"]["left"]), "<f4")
    left = left.reshape(len(entry["embedded"]["rows"]), len(record.vertices), -1).astype(float)
    for place, one in zip(entry["embedded"]["rows"], left, strict=True):
        expected = record.improvement_potential[entry["rows"][place]]
        assert 1.0 - float((record.weights[:, None] * one**2).sum()) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("name", ["indirect", "both"])
def test_handles_are_shown_where_they_move_to(name: str, runs: Path, tmp_path: Path) -> None:
    record = read(runs / name)
    row = best(record)
    fields, chosen = Fields(record), setup(record, row)
    still, moved = (fields.centers(row, shape)[0] for shape in ("template", "reached"))
    weights = chosen.fit(record)
    handles = len(chosen.centers)
    moves = (moved - still)[:handles]
    if name == "indirect":
        expected = np.zeros((handles, 3))
        expected[:, 2] = weights[:, 0]  # control points move by their weights
    else:
        expected = chosen.displacement(chosen.centers, weights)  # points on the surface as the surface does
    factor = float((moves * expected).sum() / (expected**2).sum())
    np.testing.assert_allclose(moves, factor * expected, atol=1e-9 * factor)
    out = tmp_path / "a.png"
    assert show.main([str(runs / name), "--pick", f"index:{row}", "--pictures", "--out", str(out)]) == 0
    assert out.stat().st_size > 10_000


@pytest.mark.parametrize("name", ["indirect", "direct"])
def test_the_page_says_what_the_parameters_are(name: str, runs: Path, browser: Browser) -> None:
    assert figures.main([str(runs / name), "--only", "report"]) == 0
    with opened(browser, runs / name / "report.html") as page:
        settled(page)
        text = page.text_content("#cards") or ""
    what = "points on the surface" if name == "direct" else "the control points"
    assert f"the parameters (displacements of {what})" in text
    assert ("V and P depend on the manipulation" in text) == (name == "direct")


def fitted(runs: Path, name: str, manipulation: str, out: Path) -> tuple[Any, Any, int]:
    row = best(read(runs / name))
    keys = ["--pick", f"index:{row}", "--manipulation", manipulation, "--generations", "60", "--out", str(out)]
    assert fitting.main([str(runs / name), *keys, "--quiet"]) == 0
    return json.loads((out / "fit.json").read_text()), dict(np.load(out / "parameters.npz")), row


@pytest.mark.parametrize(
    ("name", "manipulation"),
    [("indirect", "indirect"), ("indirect", "orthogonalized"), ("direct", "direct"), ("direct", "indirect")],
)
def test_fits_reach_what_the_columns_do(
    name: str, manipulation: str, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])
    summary, arrays, row = fitted(runs, name, manipulation, tmp_path / "fit")
    record = read(runs / name)
    assert record.genotype is not None
    c, h = record.genotype[row, :2], record.genotype[row, 2:]
    B = pygem(record.vertices, c - h, 2.0 * h, (4, 3))
    U = B @ np.linalg.pinv(pygem(record.centers[row], c - h, 2.0 * h, (4, 3))) if manipulation == "direct" else B
    norm = record.gradient_norm
    assert norm is not None
    wanted = norm * record.gradient
    left = wanted - U @ np.linalg.lstsq(U, wanted, rcond=None)[0]
    assert summary["optimum"] == pytest.approx(float((left**2).sum()), rel=1e-6)
    assert summary["reached"] or manipulation != "orthogonalized"
    reached = B @ arrays["weights"]
    np.testing.assert_allclose(arrays["deformed"][:, 2], reached[:, 0], atol=1e-9)
    if manipulation != "orthogonalized":
        np.testing.assert_allclose(U @ arrays["parameters"], reached, atol=1e-9)
    assert float(((wanted - reached) ** 2).sum()) == pytest.approx(summary["error"], rel=1e-9)
    assert summary["error"] >= summary["optimum"] * (1.0 - 1e-9)
    handles = record.centers[row] if manipulation == "direct" else setup(record, row).weight_places
    np.testing.assert_allclose(arrays["centers"], handles, atol=1e-12)
    moved = arrays["moved_centers"][:, 2]
    expected = (
        pygem(handles, c - h, 2.0 * h, (4, 3)) @ arrays["weights"] if manipulation == "direct" else arrays["weights"]
    )
    np.testing.assert_allclose(moved, expected[:, 0], atol=1e-9)


def test_what_cannot_be_fitted_is_told_in_a_line(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, manipulation, line in (
        ("indirect", "direct", "this run has no points on the surface that could be moved"),
        ("symmetric", "indirect", "sensitivity"),
    ):
        keys = ["--pick", f"index:{best(read(runs / name))}", "--manipulation", manipulation]
        assert fitting.main([str(runs / name), *keys, "--out", str(tmp_path / name), "--quiet"]) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert line in err
