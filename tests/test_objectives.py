"""Several objectives: their potentials, the mean and the least of them, and the gradients of all, against NumPy."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from several import SUPPORT, eggs, phi, scenario, sources
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.candidates import grid_candidates
from rbfevo.methods.nested import nested
from rbfevo.methods.ols import ols
from rbfevo.scenarios import mesh
from rbfevo.scenarios.coarse import coarsened, matched
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.bounded import bounded_of
from rbfevo.scoring.bounded_evaluator import BoundedEvaluator
from rbfevo.scoring.combination import Combination
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.kernels import Cubic, Kernel, Wendland
from rbfevo.scoring.symmetric import evaluator_of

HELD = {"hold": [-1.9, None, None, -1.2, None, None], "hold_width": 1.0}
MIRRORED = {"symmetry": "y", "symmetry_at": 0.0, "weights": "area"}
CASES = [{}, HELD, MIRRORED, {**MIRRORED, **HELD}]
WEIGHTS = {"objective_weights": [3, 1]}
WORST = {"combine": "worst"}


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small egg with sensitivities beside it."""
    return eggs(tmp_path_factory.mktemp("eggs"))


def setups(design: Scenario, count: int = 5, m: int = 5, seed: int = 0) -> Tensor:
    """Setups on the side of the mirror that centers are searched on, if there is one; some centers lie on the plane."""
    points = design.sample(count, m, torch.Generator().manual_seed(seed))
    return design.parameterization(points)


def numpy_potentials(design: Scenario, C: np.ndarray) -> list[float]:
    """P of each objective of one setup by an SVD of each block of U."""
    X, roots = design.vertices.numpy(), design.weights.sqrt().numpy()[:, None]
    blend = 1.0 if design.blend is None else design.blend.numpy()[:, None]
    parts = [([0, 1, 2], blend * phi(X, C))]
    if design.mirror is not None:
        off = C[C[:, 1] != 0]
        plus, minus = phi(X, C) + phi(X, C * (1, -1, 1)), phi(X, off) - phi(X, off * (1, -1, 1))
        parts = [([0, 2], blend * plus), ([1], blend * minus)]
    found = []
    for g in design.fields.numpy():
        reached = 0.0
        for components, U in parts:
            left, sigma, _ = np.linalg.svd(roots * U, full_matrices=False)
            left = left[:, sigma > 1e-13 * sigma[0]]
            reached += float(np.square(left.T @ (roots * g[:, components])).sum())
        found.append(reached)
    return found


# --- the scenario ----------------------------------------------------------------------------------------------------


def test_gradients_are_stacked_by_the_roots_of_their_shares(template: Path) -> None:
    both, drag, lift = (
        scenario(template, *names, **more)
        for names, more in (
            (("s", "lift"), WEIGHTS | {"objective": ["minimize", "maximize"]}),
            (("s",), {}),
            (("lift",), {}),
        )
    )
    assert both.objectives is not None
    assert both.objectives.names == ("s", "lift")
    assert both.objectives.directions == ("minimize", "maximize")
    assert both.objectives.shares == (0.75, 0.25)
    assert both.objectives.norms == (drag.gradient_norm, lift.gradient_norm)
    expected = torch.cat([0.75**0.5 * drag.gradient, -(0.25**0.5) * lift.gradient], dim=1)
    torch.testing.assert_close(both.gradient, expected, rtol=0, atol=1e-15)
    torch.testing.assert_close(both.fields, torch.stack([drag.gradient, -lift.gradient]), rtol=0, atol=1e-15)
    assert float((both.weights[:, None] * both.gradient.square()).sum()) == pytest.approx(1.0, abs=1e-14)
    assert both.objective is None
    assert both.direction_only
    for alone, known in zip(both.each(), (drag.gradient, -lift.gradient), strict=True):
        torch.testing.assert_close(alone.gradient, known, rtol=0, atol=1e-15)
        assert alone.objectives is None


def test_each_is_smoothed_and_held_as_if_it_were_alone(template: Path) -> None:
    settings: dict[str, Any] = {**HELD, "smooth": "8%", "weights": "area"}
    both = scenario(template, **settings)
    assert both.gradient_raw is not None
    assert both.objectives is not None
    for field, raw, name in zip(both.fields, both.objectives.fields(both.gradient_raw), ("s", "lift"), strict=True):
        alone = scenario(template, name, **settings)
        assert alone.gradient_raw is not None
        torch.testing.assert_close(field, alone.gradient, rtol=0, atol=1e-15)
        torch.testing.assert_close(raw, alone.gradient_raw, rtol=0, atol=1e-15)
    assert "smooth s" in both.notes
    assert both.notes["smooth lift"].startswith("lift: g is smoothed over")


def test_a_list_of_one_is_that_one(template: Path) -> None:
    (source,) = sources(template, "s")
    one, listed = mesh(str(template), sensitivity=source), mesh(str(template), sensitivity=[source])
    assert listed.objectives is None
    assert listed.notes == one.notes
    assert torch.equal(listed.gradient, one.gradient)


def test_names_tell_files_of_one_name_apart(template: Path, tmp_path: Path) -> None:
    files = []
    for case in ("cruise", "climb"):
        (tmp_path / case).mkdir()
        files.append(str(tmp_path / case / "surface.npy"))
        np.save(files[-1], np.load(sources(template, "s")[0]))
    found = mesh(str(template), sensitivity=files).objectives
    assert found is not None
    assert found.names == ("cruise/surface", "climb/surface")
    named = mesh(str(template), sensitivity=files, objective_names=["a", "b"]).objectives
    assert named is not None
    assert named.names == ("a", "b")


MISTAKES: list[tuple[dict[str, Any], str]] = [
    ({"objective": ["minimize"]}, "1 value for 2 sensitivities"),
    ({"objective_weights": [1, 2, 3]}, "3 values for 2 sensitivities"),
    ({"sensitivity_kind": ["nodal", "nodal", "nodal"]}, "3 values for 2 sensitivities"),
    ({"objective_weights": [1, 0]}, "0 is not a positive number"),
    ({"objective_weights": -1}, "-1 is not a positive number"),
    ({"objective_weights": [1, True]}, "True is not a positive number"),
    ({"objective_weights": [1, float("nan")]}, "nan is not a positive number"),
    ({"objective_weights": [1, 2], "combine": "worst"}, "which no weight changes"),
    ({"combine": "best"}, "scenario.combine=best: choose one of mean, worst"),
    ({"objective": ["minimize", "down"]}, "scenario.objective=down: choose one of minimize, maximize"),
    ({"objective_names": ["a", "a"]}, "give each objective a name of its own"),
    ({"objective_names": ["a", " "]}, "give each objective a name of its own"),
    ({"sensitivity": []}, "name at least one sensitivity"),
    ({"sensitivity": ["s.npy", "s.npy"]}, "s.npy is listed 2 times"),
    ({"sensitivity": ["s.npy", ["x"]]}, r"\['x'\] is not the name of an array"),
    ({"sensitivity": ["s.npy", ""]}, "an empty name is not the name"),
    ({"sensitivity": ["lift.npy", "nowhere"]}, "scenario.sensitivity=nowhere: the mesh has no such array"),
    ({"sensitivity": "s.npy", "combine": "worst"}, "scenario.combine is for several sensitivities"),
    ({"sensitivity": "s.npy", "objective_weights": 2}, "scenario.objective_weights is for several sensitivities"),
    ({"sensitivity": ["s.npy"], "objective_names": ["a"]}, "scenario.objective_names is for several sensitivities"),
]


@pytest.mark.parametrize(("settings", "message"), MISTAKES, ids=[message[:30] for _, message in MISTAKES])
def test_a_mistake_is_one_line_with_both_lengths(
    settings: dict[str, Any], message: str, template: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(template.parent)
    with pytest.raises(UserError, match=message) as caught:
        mesh(str(template), **{"sensitivity": ["s.npy", "lift.npy"], **settings})
    assert "\n" not in str(caught.value)


def test_an_antisymmetric_objective_is_named(template: Path) -> None:
    x = np.load(sources(template, "s")[0])
    np.save(template.parent / "odd.npy", x * (1, 0, 0) * np.sign(x[:, 1:2]))
    with pytest.raises(UserError, match="the wanted displacement of odd is antisymmetric"):
        scenario(template, "s", "odd", **MIRRORED)


# --- values ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["eager", "fused"])
@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
@pytest.mark.parametrize("case", CASES, ids=["plain", "held", "mirrored", "mirrored and held"])
def test_potentials_are_those_of_an_svd(case: dict[str, Any], manipulation: str, backend: str, template: Path) -> None:
    mean, worst = (scenario(template, **case, **more) for more in (WEIGHTS, WORST))
    C = setups(mean)
    expected = np.array([numpy_potentials(mean, centers) for centers in C.numpy()])
    for design, combined in ((mean, expected @ (0.75, 0.25)), (worst, expected.min(1))):
        evaluate = evaluator_of(design, Wendland(SUPPORT), manipulation, backend)
        for scores, each in (evaluate.of_each(C), evaluate.definition_of_each(C)):
            np.testing.assert_allclose(each.numpy(), expected, atol=1e-10)
            np.testing.assert_allclose(scores.improvement_potential.numpy(), combined, atol=1e-10)
        spectrum = evaluate.spectrum(C)
        np.testing.assert_allclose(spectrum.potentials.numpy(), expected, atol=1e-10)
        np.testing.assert_allclose(spectrum.potential.numpy(), combined, atol=1e-10)
        np.testing.assert_allclose(evaluate(C).improvement_potential.numpy(), combined, atol=1e-10)
    stacked = Evaluator(mean.vertices, mean.gradient, Wendland(SUPPORT), manipulation, mean.weights, blend=mean.blend)
    if mean.mirror is None:  # the mean is P of the stacked gradient
        np.testing.assert_allclose(stacked(C).improvement_potential.numpy(), expected @ (0.75, 0.25), atol=1e-10)


def test_ill_conditioned_and_deficient_setups_have_potentials_too(template: Path) -> None:
    design = scenario(template, **WORST)
    C = setups(design, 3)
    C[0, 1] = C[0, 0] + 1e-9  # a further pass, or QR
    C[1, 1] = C[1, 0]  # rank 4
    C[2, 2, 0] = torch.nan
    for kernel in (Wendland(SUPPORT), Cubic()):
        evaluate = evaluator_of(design, kernel, "indirect", "eager")
        scores, each = evaluate.of_each(C)
        for i in range(2):
            alone = [evaluator_of(one, kernel, "indirect", "eager").definition(C[i]) for one in design.each()]
            expected = [float(one.improvement_potential) for one in alone]
            np.testing.assert_allclose(each[i].numpy(), expected, atol=1e-7)
            assert float(scores.improvement_potential[i]) == float(each[i].min())
        assert bool(scores.failed[2])
        assert not each[2].any()
        assert evaluate.failed_evaluations == 1
    assert evaluator_of(design, Wendland(SUPPORT), "indirect", "eager").of_each(C[:0])[1].shape == (0, 2)


@pytest.mark.parametrize("case", CASES[::2], ids=["plain", "mirrored"])
def test_bounded_potentials_are_those_of_each_alone(case: dict[str, Any], template: Path) -> None:
    mean, worst = (scenario(template, **case, **more) for more in (WEIGHTS, WORST))
    kernel, C = Wendland(SUPPORT), setups(mean, 3)
    alone = [bounded_of(scenario(template, name, **case), kernel, 16.0, mean.mirror) for name in ("s", "lift")]
    expected = torch.stack([one.definition(C) for one in alone], dim=1)
    for design, combined in (
        (mean, expected @ torch.tensor([0.75, 0.25], dtype=torch.float64)),
        (worst, expected.amin(1)),
    ):
        plain = evaluator_of(design, kernel, "indirect", "eager")
        evaluate = BoundedEvaluator(plain, [bounded_of(one, kernel, 16.0, one.mirror) for one in design.each()])
        scores, each = evaluate.definition_of_each(C)
        torch.testing.assert_close(each, expected, rtol=1e-9, atol=0)
        torch.testing.assert_close(scores.improvement_potential, combined, rtol=1e-9, atol=0)
        torch.testing.assert_close(evaluate(C).improvement_potential, combined, rtol=2e-6, atol=0)
        torch.testing.assert_close(scores.regularity, plain.definition(C).regularity, rtol=0, atol=0)
        first = evaluate.spectrum(C)
        assert first.near is not None
        assert first.near.shape[:2] == (3, 2)
        again = evaluate.spectrum(C, first.near)
        torch.testing.assert_close(again.potentials, first.potentials, rtol=1e-9, atol=0)
        broken = C.clone()
        broken[1, 0, 0] = torch.inf
        scores, each = evaluate.of_each(broken)
        assert scores.failed.tolist() == [False, True, False]
        assert not each[1].any()


# --- gradients -------------------------------------------------------------------------------------------------------


def evaluators(design: Scenario, kernel: Kernel, manipulation: str) -> list[Evaluator]:
    plain = evaluator_of(design, kernel, manipulation, "eager")
    return [plain, BoundedEvaluator(plain, [bounded_of(one, kernel, 16.0, one.mirror) for one in design.each()])]


@pytest.mark.parametrize("combine", [WEIGHTS, WORST], ids=["mean", "worst"])
@pytest.mark.parametrize(
    ("case", "manipulation"), [({}, "direct"), (HELD, "indirect"), ({**MIRRORED, **HELD}, "direct")]
)
def test_gradients_are_those_of_finite_differences(
    case: dict[str, Any], manipulation: str, combine: dict[str, Any], template: Path
) -> None:
    design = scenario(template, **case, **combine)
    C = setups(design, 3, seed=3)
    way = torch.randn(C.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    if design.mirror is not None:  # centers on the plane stay there
        way[..., 1] = torch.where(design.mirror.on_plane(C), 0.0, way[..., 1])
    mixed = torch.tensor([0.3, -1.2], dtype=torch.float64)
    for evaluate, tolerance in zip(evaluators(design, Wendland(SUPPORT), manipulation), (1e-7, 1e-6), strict=True):
        spectrum = evaluate.spectrum(C)
        assert float((spectrum.potentials[:, 0] - spectrum.potentials[:, 1]).abs().min()) > 1e-3  # away from ties
        none, h = torch.zeros_like(spectrum.sigma), 1e-5
        ahead, behind = (evaluate.definition_of_each(C + s * h * way) for s in (1, -1))
        found = spectrum.backward(none, torch.ones(len(C), dtype=torch.float64))
        expected = (ahead[0].improvement_potential - behind[0].improvement_potential) / (2 * h)
        torch.testing.assert_close((found * way).flatten(1).sum(1), expected, rtol=tolerance, atol=tolerance)
        found = spectrum.backward(none, mixed.expand(len(C), 2))
        expected = ((ahead[1] - behind[1]) / (2 * h)) @ mixed
        torch.testing.assert_close((found * way).flatten(1).sum(1), expected, rtol=tolerance, atol=tolerance)


def test_the_smooth_least_potential_is_near_the_least_and_has_its_gradient() -> None:
    P = torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    P[0] = 0.6
    combination = Combination((0.2, 0.3, 0.5), worst=True)
    for sharpness in (16.0, 64.0):
        value, slopes = combination.smooth(P, sharpness)
        assert (value >= P.amin(1) - 1e-15).all()
        assert (1.0 - value >= (1.0 - P.amin(1)) * 3 ** (-1.0 / sharpness) - 1e-15).all()
        assert float(value[0]) == pytest.approx(0.6, abs=1e-14)
        assert slopes[0].tolist() == pytest.approx([1 / 3] * 3)
        for j in range(3):
            step = torch.zeros_like(P)
            step[:, j] = 1e-6
            ahead, behind = (combination.smooth(P + s * step, sharpness)[0] for s in (1, -1))
            torch.testing.assert_close((ahead - behind) / 2e-6, slopes[:, j], rtol=1e-6, atol=1e-8)
    mean = Combination((0.2, 0.3, 0.5))
    value, slopes = mean.smooth(P, 16.0)
    torch.testing.assert_close(value, P @ torch.tensor([0.2, 0.3, 0.5], dtype=torch.float64))
    assert slopes[7].tolist() == [0.2, 0.3, 0.5]


# --- heuristics and coarse designs -----------------------------------------------------------------------------------


def textbook(columns: np.ndarray, fields: list[np.ndarray], count: int, worst: bool) -> list[int]:
    """Greedy picks by definition: at each pick P of every objective by an SVD, for every candidate."""
    chosen: list[int] = []
    for _ in range(count):
        values = []
        for candidate in range(columns.shape[1]):
            U = columns[:, [*chosen, candidate]]
            left, sigma, _ = np.linalg.svd(U, full_matrices=False)
            left = left[:, sigma > 1e-10 * sigma[0]]
            if left.shape[1] < U.shape[1]:
                values.append(-1.0)
                continue
            P = [np.square(left.T @ g).sum() / np.square(g).sum() for g in fields]
            values.append(min(P) if worst else float(np.mean(P)))
        chosen.append(int(np.flatnonzero(np.array(values) >= max(values) - 1e-9)[0]))
    return chosen


@pytest.mark.parametrize("worst", [False, True])
def test_ols_is_greedy_on_the_mean_or_on_the_least(worst: bool, template: Path) -> None:
    design = scenario(template, "s", "lift", "climb", **(WORST if worst else {}))
    low, high = design.search_box
    candidates = grid_candidates(low, high, 5)
    columns = phi(design.vertices.numpy(), candidates.numpy())
    expected = textbook(columns, list(design.fields.numpy()), 6, worst)
    table = torch.from_numpy(columns)

    def looked_up(centers: Tensor) -> Tensor:
        return table[:, torch.cdist(centers, candidates).argmin(1)]

    for memory in (1e9, 0.0):
        found = ols(looked_up, candidates, design.gradient, 6, groups=3 if worst else 1, memory=memory)
        assert found.indices.tolist() == expected
    left, _, _ = np.linalg.svd(columns[:, expected], full_matrices=False)
    P = [np.square(left.T @ g).sum() for g in design.fields.numpy()]
    assert float(found.gains.sum()) == pytest.approx(min(P) if worst else np.mean(P), rel=1e-9)
    other = textbook(columns, list(design.fields.numpy()), 6, not worst)
    assert other != expected


@pytest.mark.parametrize("worst", [False, True])
def test_the_nested_sequence_is_greedy_on_bounded_potentials(worst: bool, template: Path) -> None:
    design = coarsened(scenario(template, **(WORST if worst else {})), 60)
    kernel, candidates = Wendland(SUPPORT), grid_candidates(*design.search_box, 3)
    bounded = [bounded_of(one, kernel, 16.0) for one in design.each()]
    combination, chosen = Combination.of(design.objectives), []
    for _ in range(3):
        values = []
        for i in range(len(candidates)):
            setup = candidates[torch.tensor([*chosen, i])][None]
            values.append(float(combination(torch.stack([one.values(setup, gap=0.0) for one in bounded], dim=1))))
        values = [-1.0 if i in chosen or not np.isfinite(value) else value for i, value in enumerate(values)]
        chosen.append(int(np.flatnonzero(np.array(values) >= max(values) - 1e-9)[0]))

    def columns(centers: Tensor) -> Tensor:
        return torch.from_numpy(phi(design.vertices.numpy(), centers.numpy()))

    found = nested(bounded, columns, lambda c: c, candidates, 3, tried=len(candidates), combination=combination)
    assert found.indices.tolist() == chosen
    screened = nested(bounded, columns, lambda c: c, candidates, 3, combination=combination)
    assert float(screened.potential[-1]) >= 0.9 * float(found.potential[-1])


def test_each_objective_of_a_coarse_design_is_matched_by_itself(template: Path) -> None:
    full = scenario(template, **WORST)
    fewer = coarsened(full, 40)
    C, kernel = setups(full, 20), Wendland(SUPPORT)
    expected = evaluator_of(full, kernel, "indirect", "eager").of_each(C)[1]
    before = evaluator_of(fewer, kernel, "indirect", "eager").of_each(C)[1]
    scaled = matched(fewer, before, expected)
    after = evaluator_of(scaled, kernel, "indirect", "eager").of_each(C)[1]
    for j, (one, other) in enumerate(zip(fewer.each(), scaled.each(), strict=True)):
        alone = matched(one, before[:, j], expected[:, j])
        torch.testing.assert_close(other.gradient, alone.gradient, rtol=1e-12, atol=1e-15)
        factor = after[:, j] / before[:, j]
        torch.testing.assert_close(factor, factor[:1].expand_as(factor), rtol=1e-9, atol=0)
        assert float((after[:, j] - expected[:, j]).norm()) <= float((before[:, j] - expected[:, j]).norm()) + 1e-12
    assert [float(p) for p in itertools.chain(*after[:1])] != [float(p) for p in itertools.chain(*before[:1])]
