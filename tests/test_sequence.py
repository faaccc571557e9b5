"""The nested sequence of `method=ols`: what the first 1, 2, ... of its centers score, against plain NumPy."""

from __future__ import annotations

import csv
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from designs import DESIGNS, KERNELS, PAIRS, numpy_phi
from scipy.spatial.distance import cdist
from slabs import ring, saved, strip
from test_mesh_runs import SUPPORT, egg, plain_scores
from test_ols import textbook

from rbfevo.__main__ import main
from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.methods import OlsHeuristic
from rbfevo.methods.candidates import TooFewCandidatesError
from rbfevo.runs.assembly import Parts
from rbfevo.runs.journal import Journal
from rbfevo.runs.sequence import picks
from rbfevo.runs.source import settings_of
from rbfevo.scoring.bounded import BoundedPotential
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.fronts import enough_of
from rbfevo.scoring.kernels import Wendland
from rbfevo.scoring.prefixes import bounded_prefixes, shared_scores
from rbfevo.scoring.representations import RBF
from rbfevo.scoring.symmetric import MirroredEvaluator

PLANE = ("scenario=plane", "scenario.resolution=[20,20]", "method=ols", "method.per_axis=8", "quiet=true")


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def columns(path: Path) -> dict[str, np.ndarray]:
    """The columns of a table of numbers."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def arrays(run: Path) -> dict[str, np.ndarray]:
    with np.load(run / "setups.npz") as setups, np.load(run / "scenario.npz") as scenario:
        return {**scenario, **setups}


def plain(U: np.ndarray, g: np.ndarray, weights: np.ndarray, psi: np.ndarray | None) -> tuple[float, float]:
    """R and P of U [n, m], or of U Psi^-1, by NumPy's SVD."""
    U, g = np.sqrt(weights)[:, None] * U, np.sqrt(weights)[:, None] * g
    left, sigma, _ = np.linalg.svd(U, full_matrices=False)
    kept = sigma > max(U.shape) * np.finfo(float).eps * sigma[0]
    potential = 1.0 - ((g - left[:, kept] @ (left[:, kept].T @ g)) ** 2).sum() / (g**2).sum()
    if not kept.all():
        return 0.0, potential
    if psi is not None:
        sigma = np.linalg.svd(np.linalg.solve(psi, U.T).T, compute_uv=False)
    return sigma[-1] / sigma[0], potential


# --- scores of setups that share their centers -----------------------------------------------------------------------


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize(("name", "kernel"), PAIRS)
def test_prefixes_score_as_plain_numpy_scores_them(name: str, kernel: str, manipulation: str) -> None:
    design, phi = DESIGNS[name](weighted=True), KERNELS[name][kernel]
    centers = design.centers(14)
    blend = torch.linspace(0.0, 1.0, len(design.vertices), dtype=torch.float64)
    evaluator = Evaluator(*design_of(design), phi, manipulation, design.weights, "eager", blend=blend)
    R, P = shared_scores(evaluator, [centers[:m] for m in range(1, 15)])
    X, C = design.vertices.numpy(), centers.numpy()
    for m in range(1, 15):
        U = blend.numpy()[:, None] * numpy_phi(phi, cdist(X, C[:m]))
        psi = numpy_phi(phi, cdist(C[:m], C[:m])) if manipulation == "direct" else None
        if psi is not None and (m == 1 and phi.support is None):
            assert float(R[0]) == 0.0  # Psi is [0]
            continue
        regularity, potential = plain(U, design.gradient.numpy(), design.weights.numpy(), psi)
        assert abs(float(R[m - 1]) - regularity) <= 1e-8 * regularity + 1e-13
        assert abs(float(P[m - 1]) - potential) <= 1e-10


def design_of(design: Any) -> tuple[torch.Tensor, torch.Tensor]:
    return design.vertices, design.gradient


def test_setups_share_columns_in_any_order_and_degenerate_ones_score_as_defined() -> None:
    design = DESIGNS["plane"]()
    centers = design.centers(6)
    far = torch.tensor([[9.0, 9.0]], dtype=torch.float64)
    twice = torch.cat((centers[:2], centers[:1]))
    setups = [centers[[4, 1, 3]], centers[[1, 3, 5, 0]], far, torch.cat((centers[:2], far)), twice, centers]
    for manipulation in ("indirect", "direct"):
        evaluator = Evaluator(*design_of(design), Wendland(0.5), manipulation, backend="eager")
        R, P = shared_scores(evaluator, setups)
        for i, setup in enumerate(setups):
            expected = evaluator.definition(setup)
            assert float(R[i]) == pytest.approx(float(expected.regularity), rel=1e-9, abs=1e-14)
            assert float(P[i]) == pytest.approx(float(expected.improvement_potential), abs=1e-11)
        assert R[2] == R[3] == R[4] == P[2] == 0.0
        assert min(P[0], P[3], P[4]) > 0.0


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_symmetric_prefixes_score_by_both_blocks(manipulation: str) -> None:
    design, mirror = DESIGNS["sphere"](subdivisions=2, weighted=True), Mirror(1, 0.0, 1e-12)
    centers = design.centers(9).abs()
    centers[3, 1] = centers[6, 1] = 0.0
    first_on_plane = torch.cat((centers[3:4], centers[:3]))
    given = (*design_of(design), Wendland(1.0), manipulation, design.weights, "eager")
    evaluator = MirroredEvaluator(*given, mirror=mirror)
    setups = [*(centers[:m] for m in range(1, 10)), *(first_on_plane[:m] for m in range(1, 5))]
    R, P = shared_scores(evaluator, setups)
    for i, setup in enumerate(setups):
        expected = evaluator.definition(setup)
        assert float(R[i]) == pytest.approx(float(expected.regularity), rel=1e-10)
        assert float(P[i]) == pytest.approx(float(expected.improvement_potential), abs=1e-12)


def test_bounded_prefixes_are_those_of_the_definition_without_a_start() -> None:
    design = DESIGNS["sphere"](subdivisions=2)
    centers, bounded = design.centers(7), BoundedPotential(*design_of(design), RBF(Wendland(1.0)), 16.0, design.weights)
    setups = [centers[:m] for m in range(1, 8)]
    found = bounded_prefixes(bounded, setups, centers)
    expected = [float(bounded.definition(setup[None])[0]) for setup in setups]
    np.testing.assert_allclose(found.numpy(), expected, atol=1e-10)
    assert (found.diff() > 0).all()


# --- runs ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_the_sequence_of_a_run_is_a_plain_greedy_one(manipulation: str, tmp_path: Path) -> None:
    given = (*PLANE, f"manipulation={manipulation}", f"hydra.run.dir={tmp_path}", "centers=12", "quiet=false")
    assert main(list(given)) == 0
    files, table = arrays(tmp_path), columns(tmp_path / "sequence.csv")
    X, g = files["vertices"], files["gradient"]
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 8), np.linspace(0, 2, 8), indexing="ij"), axis=-1).reshape(-1, 2)
    phi = Wendland(0.5)
    chosen, gains = textbook(numpy_phi(phi, cdist(X, grid)), g, 12)
    C = grid[chosen]
    assert table["centers"].tolist() == list(range(1, 13))
    np.testing.assert_allclose(np.column_stack([table["x"], table["y"]]), C, atol=1e-15)
    np.testing.assert_allclose(table["improvement_potential"], np.cumsum(gains), atol=1e-8)
    for m in range(1, 13):
        psi = numpy_phi(phi, cdist(C[:m], C[:m])) if manipulation == "direct" else None
        regularity, potential = plain(numpy_phi(phi, cdist(X, C[:m])), g, files["weights"], psi)
        assert table["regularity"][m - 1] == pytest.approx(regularity, rel=1e-9)
        assert table["improvement_potential"][m - 1] == pytest.approx(potential, abs=1e-10)
    assert table["regularity"][-1] == pytest.approx(files["regularity"][0], rel=1e-9)


def test_a_run_prints_from_where_on_another_center_hardly_pays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*PLANE[:-1], f"hydra.run.dir={tmp_path}", "centers=12"]) == 0
    gains = np.sqrt(columns(tmp_path / "sequence.csv")["improvement_potential"])
    number = 1 + int(np.flatnonzero(gains >= 0.95 * gains.max())[0])
    line = f"the first {number} of 12 centers reach 95% of the gain of all, the square root of P"
    assert line in capsys.readouterr().out.splitlines()


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return egg(tmp_path_factory.mktemp("egg"))


def on_egg(out: Path, template: Path, *more: str) -> Path:
    files = [f"scenario.template={template}", f"scenario.sensitivity={template.parent / 's.npy'}"]
    given = ["method=ols", "method.per_axis=6", "quiet=true", f"hydra.run.dir={out}", f"kernel.support={SUPPORT}"]
    assert main(["scenario=mesh", *files, *given, "scenario.weights=area", *more]) == 0
    return out


def test_symmetric_sequences_are_those_of_runs_with_fewer_centers(template: Path, tmp_path: Path) -> None:
    symmetric = ("scenario.symmetry=y", "scenario.symmetry_at=0", "manipulation=direct")
    whole = on_egg(tmp_path / "7", template, "centers=7", *symmetric)
    table = columns(whole / "sequence.csv")
    for m in range(1, 8):
        files = arrays(whole if m == 7 else on_egg(tmp_path / str(m), template, f"centers={m}", *symmetric))
        if m == 1:  # on the plane, without a column across
            regularity, potential = files["regularity"][0], files["improvement_potential"][0]
        else:
            regularity, potential = plain_scores(files, files["centers"][0], "wendland", direct=True)
        assert table["regularity"][m - 1] == pytest.approx(regularity, rel=1e-8)
        assert table["improvement_potential"][m - 1] == pytest.approx(potential, abs=1e-8)
        assert files["centers"][0, -1, 1] == 0 or m % 2 == 0
    assert (table["y"] > 0).any()


def test_a_held_region_counts_in_the_sequence(template: Path, tmp_path: Path) -> None:
    held = ("scenario.hold=[-1.2,null,null,0.3,null,null]", "scenario.hold_width=1.0")
    run = on_egg(tmp_path, template, "centers=6", *held)
    files, table = arrays(run), columns(run / "sequence.csv")
    C = np.column_stack([table["x"], table["y"], table["z"]])
    assert np.unique(files["blend"]).size > 10
    for m in range(1, 7):
        U = files["blend"][:, None] * numpy_phi(Wendland(SUPPORT), cdist(files["vertices"], C[:m]))
        regularity, potential = plain(U, files["gradient"], files["weights"], None)
        assert table["regularity"][m - 1] == pytest.approx(regularity, rel=1e-9)
        assert table["improvement_potential"][m - 1] == pytest.approx(potential, abs=1e-10)


def test_a_planar_sequence_stays_in_the_plane_and_a_bounded_one_has_its_potential(tmp_path: Path) -> None:
    x, y = np.tile(ring(64), (2, 1)).T
    s = np.stack([np.exp(-((x - 1.0) ** 2)), y, 0.0 * x], axis=1)
    slab = saved(strip(64), tmp_path / "slab.vtp", s=s)
    given = [f"scenario.template={slab}", "scenario.sensitivity=s", "scenario.planar=z", "criterion.norm=16"]
    given += ["method=ols", "method.per_axis=6", "quiet=true", "centers=5", "kernel.support=1.2"]
    assert main(["scenario=mesh", *given, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    files, table = arrays(tmp_path / "run"), columns(tmp_path / "run" / "sequence.csv")
    C = np.column_stack([table["x"], table["y"], table["z"]])
    assert (C[:, 2] == 0.05).all()
    np.testing.assert_array_equal(C, files["centers"][0])
    tensors = [torch.from_numpy(files[name]) for name in ("vertices", "gradient")]
    bounded = BoundedPotential(*tensors, RBF(Wendland(1.2)), 16.0, torch.from_numpy(files["weights"]))
    for m in range(1, 6):
        assert table["bounded_potential"][m - 1] == pytest.approx(
            float(bounded.definition(torch.from_numpy(C[None, :m]))[0]), abs=1e-9
        )
        U = numpy_phi(Wendland(1.2), cdist(files["vertices"], C[:m]))
        assert table["improvement_potential"][m - 1] == pytest.approx(
            plain(U, files["gradient"], files["weights"], None)[1], abs=1e-10
        )
    assert table["bounded_potential"][-1] == pytest.approx(files["bounded_potential"][0], abs=1e-9)
    assert (np.diff(table["bounded_potential"]) > 0).all()


def test_a_panel_has_the_sequence_of_its_ols_and_another_method_has_none(tmp_path: Path) -> None:
    budget = ["method.nsga2.generations=2", "method.nsga2.population=8", "method.cmaes.generations=2"]
    budget += ["method.cmaes.population=8", "method.cmaes.parents=3", "method.lloyd.starts=1", "quiet=true"]
    small = ["scenario.resolution=[12,12]", "centers=4", "method.ols.per_axis=8", "preference=0.5"]
    assert main(["method=panel", *small, *budget, f"hydra.run.dir={tmp_path / 'panel'}"]) == 0
    files, table = arrays(tmp_path / "panel"), columns(tmp_path / "panel" / "sequence.csv")
    (row,) = np.flatnonzero(files["method"] == "ols")
    np.testing.assert_array_equal(np.column_stack([table["x"], table["y"]]), files["centers"][row])
    assert table["improvement_potential"][-1] == pytest.approx(files["improvement_potential"][row], abs=1e-10)
    assert main(["method=lloyd", *small[:2], "quiet=true", f"hydra.run.dir={tmp_path / 'lloyd'}"]) == 0
    assert not (tmp_path / "lloyd" / "sequence.csv").exists()
    assert main(["method=lloyd", *small[:2], "quiet=true", f"hydra.run.dir={tmp_path / 'panel'}"]) == 2


def test_a_resumed_run_writes_the_same_sequence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert main([*PLANE, "centers=5", f"hydra.run.dir={tmp_path / 'calm'}"]) == 0
    write_lines = Journal.record

    def record_and_interrupt(journal: Journal, lines: Any) -> None:
        write_lines(journal, lines)
        signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "record", record_and_interrupt)
        assert main([*PLANE, "centers=5", f"hydra.run.dir={tmp_path / 'torn'}"]) == 143
    (tmp_path / "torn" / "sequence.csv").unlink()
    assert main([f"resume={tmp_path / 'torn'}"]) == 0
    assert (tmp_path / "torn" / "sequence.csv").read_bytes() == (tmp_path / "calm" / "sequence.csv").read_bytes()


# --- how long it can be ----------------------------------------------------------------------------------------------


def test_a_sequence_ends_where_no_candidate_is_left_and_says_so(tmp_path: Path) -> None:
    small = ["scenario=plane", "scenario.resolution=[6,6]", "method=ols", "centers=3", "quiet=true"]
    assert main([*small, f"hydra.run.dir={tmp_path / 'run'}"]) == 0
    parts = Parts(settings_of(tmp_path / "run"))
    found = picks(parts, 100)
    assert len(found.centers) == 36  # there are no more independent columns than vertices
    assert found.note == "no other candidate has a column of its own: the sequence ends with 36 centers"
    few = picks(parts, 7)
    assert few.note == ""
    np.testing.assert_array_equal(few.centers.numpy(), found.centers[:7].numpy())
    problem = parts.problem()
    with pytest.raises(TooFewCandidatesError, match="only 36 of the 900 OLS candidates") as caught:
        OlsHeuristic().picks(type(problem)(**{**vars(problem), "centers": 40}))
    assert caught.value.found == 36
    assert main([*small[:3], "centers=36", "quiet=true", f"hydra.run.dir={tmp_path / 'all'}"]) == 0
    assert columns(tmp_path / "all" / "sequence.csv")["improvement_potential"][-1] == pytest.approx(1.0, abs=1e-9)


def test_a_run_that_asks_for_too_many_centers_is_still_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["scenario.resolution=[12,12]", "method=ols", "method.per_axis=3", "centers=10", "quiet=true"]
    assert main([*given, f"hydra.run.dir={tmp_path / 'run'}"]) == 2
    assert "OLS cannot pick 10 centers from 9 candidates: refine the candidate grid" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_large_design_is_coarsened_for_the_picks_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores are of all vertices, whatever the picks have looked at."""
    assert main([*PLANE, "centers=3", f"hydra.run.dir={tmp_path}"]) == 0
    parts = Parts(settings_of(tmp_path))
    looked: list[int] = []
    real = OlsHeuristic.picks

    def watched(self: OlsHeuristic, problem: Any) -> torch.Tensor:
        looked.append(len(problem.scenario.vertices))
        return real(self, problem)

    monkeypatch.setattr(OlsHeuristic, "picks", watched)
    picks(parts, 5)
    monkeypatch.setattr("rbfevo.runs.sequence.KEPT", 1.0)
    monkeypatch.setattr("rbfevo.runs.sequence.FEWEST", 50)
    picks(parts, 5)
    assert looked[0] == 400
    assert looked[1] <= 50


# --- the rule --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gains", "expected"),
    [
        ([0.5, 0.9, 0.95, 1.0], 3),
        ([0.5, 0.9, 0.9499, 1.0], 4),
        ([1.0, 0.9, 0.95, 1.0], 1),
        ([0.0, 0.0, 0.0, 0.0], None),
        ([float("nan"), 0.2, float("nan"), 0.1], 2),
    ],
)
def test_the_smallest_number_with_enough_of_the_largest_gain(gains: list[float], expected: int | None) -> None:
    assert enough_of([1, 2, 3, 4], gains) == expected


def test_a_representation_without_centers_is_refused_by_name(tmp_path: Path) -> None:
    assert main([*PLANE, "centers=3", f"hydra.run.dir={tmp_path}"]) == 0
    parts = Parts(settings_of(tmp_path))

    class Other(RBF):
        name = "other"

        def atoms(self, points: Any) -> Any:
            return None

    parts.representation = Other(Wendland(0.5))
    with pytest.raises(UserError, match="representation=other has none"):
        picks(parts, 5)
