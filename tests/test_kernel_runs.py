"""Whole runs with each kernel: scores beside plain NumPy, the page's own residual, exports, and PyGeM's files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
import pyvista as pv
from browsers import opened, settled
from scipy.spatial.distance import cdist
from test_export import parse_pygem, table
from test_mesh_runs import egg

from rbfevo import apply, collect, export
from rbfevo.__main__ import main
from rbfevo.recorded.exported import read_export
from rbfevo.recorded.record import read
from rbfevo.recorded.setup import setup

if TYPE_CHECKING:
    from playwright.sync_api import Browser

S = 0.825
FORMULAS = {
    "wendland_c0": lambda q: np.clip(1 - q, 0, None) ** 2,
    "wendland_c4": lambda q: np.clip(1 - q, 0, None) ** 6 * (35 * q**2 + 18 * q + 3) / 3,
    "gaussian": lambda q: np.exp(-(q**2)),
    "multiquadric": lambda q: np.sqrt(1 + q**2),
    "inverse_multiquadric": lambda q: 1 / np.sqrt(1 + q**2),
}
COMPACT = ("wendland_c0", "wendland_c4")
IN_PYGEM = {
    "gaussian": "gaussian_spline",
    "multiquadric": "multi_quadratic_biharmonic_spline",
    "inverse_multiquadric": "inv_multi_quadratic_biharmonic_spline",
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with a run of each kernel, named by it, on a symmetric egg."""
    template, directory = egg(tmp_path_factory.mktemp("egg"), subdivisions=2), tmp_path_factory.mktemp("runs")
    mesh = ["scenario=mesh", f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"]
    mesh += ["scenario.symmetry=y", "scenario.symmetry_at=0", "manipulation=direct", "quiet=true", "figures=false"]
    for name in FORMULAS:
        key = "support" if name in COMPACT else "scale"
        search = ["method=gradient", "method.starts=16", "method.population=16", "method.generations=5", "centers=4"]
        size = [f"kernel={name}", f"kernel.{key}={S}", f"hydra.run.dir={directory / name}"]
        assert main([*mesh, *size, *search, "method.front=6", "method.polish=2"]) == 0
    return directory


@pytest.mark.parametrize("name", FORMULAS)
def test_scores_are_those_of_the_formula(name: str, runs: Path) -> None:
    record = read(runs / name)
    assert f"{name} kernel, {'support radius' if name in COMPACT else 'scale'} 0.825" in record.title
    for row in record.front[[0, -1]].tolist():
        chosen = setup(record, row)
        C, off = chosen.centers, chosen.centers[chosen.off_plane]
        formula = FORMULAS[name]
        values, left = [], 0.0
        for components, own, sign in (([0, 2], C, 1.0), ([1], off, -1.0)):
            images = own * (1, -1, 1)

            def phi(X: Any, own: Any = own, images: Any = images, sign: float = sign, f: Any = formula) -> Any:
                return f(cdist(X, own) / S) + sign * f(cdist(X, images) / S)

            if not len(own):
                continue
            U = phi(record.vertices)
            wanted = record.gradient[:, components]
            left += float(np.square(wanted - U @ np.linalg.lstsq(U, wanted, rcond=None)[0]).sum())
            values.append(np.linalg.svd(np.linalg.solve(phi(own).T, U.T).T, compute_uv=False))
        every = np.concatenate(values)
        assert record.improvement_potential[row] == pytest.approx(1 - left, abs=1e-9)
        assert record.regularity[row] == pytest.approx(every.min() / every.max(), rel=1e-6)


@pytest.mark.parametrize("name", FORMULAS)
def test_an_export_deforms_as_the_formula_does_and_can_be_rebuilt(name: str, runs: Path, tmp_path: Path) -> None:
    out, record = tmp_path / "out", read(runs / name)
    assert export.main([str(runs / name), "--pick", "knee", "--quiet", "--out", str(out)]) == 0
    arguments = [str(runs / name), "--pick", "knee", "--displacements", str(out / "displacements.csv"), "--quiet"]
    arguments += ["--mesh", str(out / "template.vtp"), "--out", str(out / "moved.vtp")]
    assert apply.main(arguments) == 0
    template: Any = pv.read(out / "template.vtp")
    moved: Any = pv.read(out / "moved.vtp")
    reached = np.asarray(moved.points) - np.asarray(template.points)
    np.testing.assert_allclose(reached, template["reached"], atol=1e-7)
    _, weights = table(out / "weights.csv")
    w = weights[:, -3:]
    with np.load(out / "setup.npz") as arrays:
        C = arrays["centers"]
    direct, mirrored = (FORMULAS[name](cdist(record.vertices, places) / S) for places in (C, C * (1, -1, 1)))
    off = np.where(C[:, 1] != 0, 1.0, 0.0)
    expected = np.empty_like(reached)
    expected[:, [0, 2]] = (direct + off * mirrored + (1 - off) * direct) @ w[:, [0, 2]]
    expected[:, 1] = (direct - mirrored) @ (off * w[:, 1])
    np.testing.assert_allclose(reached, expected, atol=1e-7)
    rebuilt, _ = read_export(out / "setup.npz")
    again = setup(rebuilt, 0)
    np.testing.assert_allclose(again.displacement(record.vertices, again.weights(w)),
                               setup(record, int(np.load(out / "setup.npz")["row"])).displacement(
                                   record.vertices, again.weights(w)), atol=1e-12)  # fmt: skip


@pytest.mark.parametrize("name", FORMULAS)
def test_pygem_gets_its_own_name_of_the_kernel(
    name: str, runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = read(runs / name)
    row = next(i for i in record.usable.tolist() if len(setup(record, i).off_plane) > 2)  # not all in one plane
    assert export.main([str(runs / name), "--pick", f"index:{row}", "--out", str(tmp_path / "out")]) == 0
    file = tmp_path / "out" / "parameters.prm"
    assert file.exists() == (name in IN_PYGEM)
    if name not in IN_PYGEM:
        assert "PyGeM has no kernel that corresponds to" in capsys.readouterr().out
        return
    kernel, radius, _, original, deformed = parse_pygem(file)
    assert (kernel, radius) == (IN_PYGEM[name], S)
    theirs = {  # as PyGeM documents them
        "gaussian": lambda x: np.exp(-(x**2) / S**2),
        "multiquadric": lambda x: np.sqrt(x**2 + S**2),
        "inverse_multiquadric": lambda x: (x**2 + S**2) ** -0.5,
    }[name]
    # Their kernel is ours times a number, so that interpolation with it is the same.
    r = np.linspace(0.0, 3.0, 50)
    ratio = theirs(r) / FORMULAS[name](r / S)
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-13)
    assert np.abs(deformed - original).max() > 0


@pytest.fixture(scope="module")
def page(browser: Browser, runs: Path) -> Iterator[Any]:
    assert collect.main([str(runs), "--sequence", "0"]) == 0
    with opened(browser, runs / "report.html") as made:
        yield made


@pytest.mark.parametrize("name", FORMULAS)
def test_the_page_knows_the_formula(name: str, page: Any, runs: Path) -> None:
    record = read(runs / name)
    for row in record.front[[0, -1]].tolist():
        page.evaluate("(place) => { location.hash = `#setup=${place}`; }", f"{name}:{row}")
        page.wait_for_function(
            "([name, row]) => rbfevo.state.chosen.run.name === name && rbfevo.state.chosen.row === row", arg=[name, row]
        )
        settled(page)
        found = page.evaluate("() => rbfevo.leftOf(rbfevo.state.chosen, rbfevo.state.mesh).potential")
        assert page.evaluate("() => rbfevo.state.chosen.run.known")
        assert found == pytest.approx(record.improvement_potential[row], abs=1e-7)
