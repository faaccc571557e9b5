"""Whole runs on a mesh of one's own: every method, symmetry, regions, few vertices to search on, and what is said."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist

from rbfevo.__main__ import main

SUPPORT = 1.5
METHODS = {
    "nsga2": ["method.generations=3", "method.population=8"],
    "cmaes": ["method.generations=3", "method.population=8", "method.parents=3", "preference=[0.2,0.8]"],
    "gradient": [
        "method.generations=8",
        "method.polish=2",
        "method.starts=16",
        "method.population=16",
        "method.front=5",
    ],
    "lloyd": [],
    "ols": ["method.per_axis=6"],
    "random": ["method.population=4"],
}


def egg(directory: Path, subdivisions: int = 3) -> Path:
    """Write an egg, and a symmetric sensitivity beside it, `s.npy`: three values a vertex."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    ball.apply_transform(np.diag([2.0, 1.0, 0.8, 1.0]))
    x = np.asarray(ball.vertices)
    x[np.abs(x[:, 1]) < 1e-12, 1] = 0.0
    trimesh.Trimesh(x, ball.faces, process=False).export(directory / "egg.ply")
    read: Any = trimesh.load(directory / "egg.ply", process=False)
    x = np.asarray(read.vertices)
    np.save(directory / "s.npy", np.stack([np.exp(-((x[:, 0] + 1.5) ** 2)), x[:, 1], x[:, 2] ** 2], axis=1))
    return directory / "egg.ply"


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An egg, and a symmetric sensitivity in a file: three values a vertex."""
    return egg(tmp_path_factory.mktemp("egg"))


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def run(
    out: Path, template: Path, *overrides: str
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], dict[str, Any]]:
    fixed = [f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}", "evaluator=eager"]
    assert main([f"hydra.run.dir={out}", "scenario=mesh", *fixed, "quiet=true", "centers=5", *overrides]) == 0
    with np.load(out / "setups.npz") as setups, np.load(out / "scenario.npz") as files:
        summary = json.loads((out / "summary.json").read_text())
        return dict(setups), dict(files), summary


def plain_scores(files: dict[str, np.ndarray], setup: np.ndarray, kernel: str, direct: bool) -> tuple[float, float]:
    """R and P of a symmetric setup, from the run's own files and plain NumPy."""
    X, g, roots = files["vertices"], files["gradient"], np.sqrt(files["weights"])[:, None]

    def phi(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        r = cdist(a, b)
        return (
            r**3
            if kernel == "triharmonic"
            else np.where(r < SUPPORT, (1 - r / SUPPORT) ** 4 * (4 * r / SUPPORT + 1), 0)
        )

    sigmas, residual = [], 0.0
    for sign, components, C in ((1, [0, 2], setup), (-1, [1], setup[setup[:, 1] != 0])):
        image = C * (1, -1, 1)
        Phi = roots * (phi(X, C) + sign * phi(X, image))
        u, sigma, _ = np.linalg.svd(Phi, full_matrices=False)
        u = u[:, sigma > max(Phi.shape) * np.finfo(float).eps * sigma[0]]
        wanted = roots * g[:, components]
        residual += float(((wanted - u @ (u.T @ wanted)) ** 2).sum())
        if u.shape[1] < len(C):
            return 0.0, 1 - residual
        if direct:
            Phi = np.linalg.solve(phi(C, C) + sign * phi(image, C), Phi.T).T
        sigmas.append(np.linalg.svd(Phi, compute_uv=False))
    every = np.concatenate(sigmas)
    return every.min() / every.max(), 1 - residual


@pytest.mark.parametrize(
    ("method", "kernel", "manipulation"),
    [(method, "wendland", "indirect") for method in METHODS]
    + [("gradient", "wendland", "direct"), ("gradient", "triharmonic", "direct"), ("cmaes", "triharmonic", "indirect")],
)
def test_saved_scores_of_symmetric_setups_are_those_of_a_plain_svd(
    method: str, kernel: str, manipulation: str, template: Path, tmp_path: Path
) -> None:
    overrides = [f"kernel={kernel}", f"manipulation={manipulation}", f"method={method}", *METHODS[method]]
    overrides += ["scenario.symmetry=y", "scenario.symmetry_at=0", "scenario.weights=area"]
    overrides += [f"kernel.support={SUPPORT}"] if kernel == "wendland" else []
    setups, files, summary = run(tmp_path, template, *overrides)
    assert summary["symmetry"] == {"axis": "y", "at": 0.0}
    assert summary["gradient_is"] == "direction"
    C = setups["centers"]
    assert (C[..., 1] >= 0).all()
    assert (C[:, -1, 1] == 0).all()
    for i, setup in enumerate(C):
        regularity, potential = plain_scores(files, setup, kernel, manipulation == "direct")
        assert abs(regularity - setups["regularity"][i]) <= 1e-6 * regularity + 1e-12
        assert abs(potential - setups["improvement_potential"][i]) <= 1e-8


@pytest.mark.parametrize("count", [4, 5])
def test_even_and_odd_numbers_of_columns(count: int, template: Path, tmp_path: Path) -> None:
    overrides = [f"centers={count}", f"kernel.support={SUPPORT}", "scenario.symmetry=y", "scenario.symmetry_at=0"]
    setups, _, _ = run(tmp_path, template, "method=cmaes", *METHODS["cmaes"], *overrides)
    assert (setups["centers"][:, -1, 1] == 0).all() == (count % 2 == 1)


@pytest.mark.parametrize("method", METHODS)
def test_centers_and_images_stay_out_of_a_box_beside_the_plane(method: str, template: Path, tmp_path: Path) -> None:
    overrides = [f"method={method}", *METHODS[method], f"kernel.support={SUPPORT}", "scenario.symmetry=y"]
    overrides += ["scenario.fixed=[-1,-0.7,-9,1,0.1,9]", "scenario.keep_out=true", "scenario.symmetry_at=0"]
    setups, _, _ = run(tmp_path, template, *overrides)
    for C in (setups["centers"], setups["centers"] * (1, -1, 1)):
        assert not ((C[..., 0] > -1) & (C[..., 0] < 1) & (C[..., 1] > -0.7) & (C[..., 1] < 0.1)).any()


@pytest.mark.parametrize("method", METHODS)
def test_centers_stay_out_of_the_fixed_region(method: str, template: Path, tmp_path: Path) -> None:
    overrides = [f"method={method}", *METHODS[method], f"kernel.support={SUPPORT}"]
    overrides += ["scenario.fixed=[-99,-99,-99,-0.5,99,99]", "scenario.keep_out=true"]
    setups, files, _ = run(tmp_path, template, *overrides)
    assert setups["centers"][..., 0].min() >= -0.5
    assert (files["gradient"][files["vertices"][:, 0] <= -0.5] == 0).all()


def test_a_search_on_few_vertices_is_scored_on_all(template: Path, tmp_path: Path) -> None:
    overrides = ["method=gradient", *METHODS["gradient"], "kernel.support=1.5"]
    few, files, summary = run(tmp_path / "few", template, *overrides, "scenario.search_vertices=200")
    assert summary["vertices"] == 642
    assert 150 <= summary["search_vertices"] <= 200
    gaps = summary["search_differences"]
    assert 0 < abs(gaps["improvement_potential_median"]) <= gaps["improvement_potential_largest"] < 0.05
    assert 0 < abs(gaps["regularity_median"]) <= gaps["regularity_largest"] < 0.2
    assert len(files["vertices"]) == 642
    _, _, all_of_it = run(tmp_path / "all", template, *overrides)
    assert all_of_it["search_vertices"] == 642
    assert all_of_it["search_differences"] is None
    _, _, lloyd = run(
        tmp_path / "lloyd", template, "method=lloyd", "kernel.support=1.5", "scenario.search_vertices=200"
    )
    assert lloyd["search_differences"]["improvement_potential_largest"] < 0.02
    # What is saved are the scores on all vertices, to the contract; those of the search differ far more.
    for i in (0, -1):
        r = cdist(files["vertices"], few["centers"][i])
        Phi = np.where(r < 1.5, (1 - r / 1.5) ** 4 * (4 * r / 1.5 + 1), 0)
        sigma = np.linalg.svd(Phi, compute_uv=False)
        residual = files["gradient"] - Phi @ np.linalg.lstsq(Phi, files["gradient"], rcond=None)[0]
        assert abs(sigma[-1] / sigma[0] - few["regularity"][i]) <= 1e-6 * few["regularity"][i] + 1e-12
        assert abs(1 - (residual**2).sum() - few["improvement_potential"][i]) <= 1e-8


@pytest.mark.parametrize("size", [1e300, 1e-300])
def test_huge_and_tiny_sensitivities_leave_a_summary_that_is_json(size: float, template: Path, tmp_path: Path) -> None:
    values = np.load(template.parent / "s.npy") * size
    np.save(tmp_path / "huge.npy", values * 1e8 if size > 1 else values)  # the norm is beyond what a float holds
    overrides = ["method=random", "method.population=3", f"kernel.support={SUPPORT}"]
    overrides.append(f"scenario.sensitivity={tmp_path / 'huge.npy'}")
    found, files, summary = run(tmp_path / "run", template, *overrides)
    plain, wanted, _ = run(tmp_path / "plain", template, *overrides[:-1])
    np.testing.assert_allclose(files["gradient"], wanted["gradient"], rtol=0, atol=1e-14)
    np.testing.assert_allclose(found["improvement_potential"], plain["improvement_potential"], rtol=0, atol=1e-12)
    text = (tmp_path / "run" / "summary.json").read_text()
    assert "Infinity" not in text
    assert "NaN" not in text
    assert summary["gradient_is"] == "direction"


def test_large_results_are_scored_by_the_evaluator_and_not_counted(
    template: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    overrides = ["method=random", "method.population=6", f"kernel.support={SUPPORT}"]
    small, _, before = run(tmp_path / "small", template, *overrides)
    monkeypatch.setattr("rbfevo.runs.assembly.DEFINED_UP_TO", 100)
    large, _, after = run(tmp_path / "large", template, *overrides)
    assert (before["scored_by"], after["scored_by"]) == ("definition", "evaluator")
    assert before["evaluations"] == after["evaluations"] == 6
    np.testing.assert_allclose(large["regularity"], small["regularity"], rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(large["improvement_potential"], small["improvement_potential"], rtol=0, atol=1e-8)


def test_file_names_with_any_signs(template: Path, tmp_path: Path) -> None:
    odd = tmp_path / "a (1), b=c [x] tür's.ply"
    odd.write_bytes(template.read_bytes())
    overrides = ["method=random", "method.population=3", "scenario.weights=area"]
    _, _, summary = run(
        tmp_path / "out (1)", odd.parent / odd.name, *overrides, f"scenario.sensitivity={template.parent / 's.npy'}"
    )
    assert odd.name in summary["notes"]["template"]


def test_radii_that_do_not_fit_are_warned_about(template: Path, tmp_path: Path) -> None:
    _, _, said = run(tmp_path, template, "method=random", "method.population=5", "kernel.support=0.02")
    assert "below the vertex spacing" in said["warnings"][0]
    assert "5 of 5 setups have R = 0: some of their centers (up to " in said["warnings"][1]


def test_a_percentage_is_of_the_boxs_diagonal(template: Path, tmp_path: Path) -> None:
    _, files, summary = run(tmp_path, template, "method=lloyd", "kernel.support=30%")
    assert summary["support"] == pytest.approx(0.3 * np.linalg.norm(files["upper"] - files["lower"]))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["scenario.template=nowhere.stl"], "nowhere.stl: no such file"),
        (["scenario.symmetry=w"], "choose x, y or z"),
        (["scenario.margin=wide"], "scenario.margin=wide: a number is expected"),
        (["scenario.templat=a"], "did you mean scenario.template?"),
        (["scenario.fixed=[0,0]"], "a box is six numbers"),
        (["scenario.search_vertices=1"], "at least 100"),
        (["scenario.search_vertices=100", "centers=60"], "give at least twice centers=60"),
        (["scenario.symmetry", "y"], "write an override as key=value"),
        (["scenario.sensitivity=nothing"], "scenario.sensitivity=nothing"),
    ],
)
def test_mistakes(
    overrides: list[str], message: str, template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fixed = [f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"]
    assert main([f"hydra.run.dir={tmp_path / 'run'}", "scenario=mesh", *fixed, *overrides]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert message in lines[0]
    assert not (tmp_path / "run").exists()
