"""`rbfevo.advise`: the nested sequence against its definition, the rule by value, and one study as a user runs it."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import numpy as np
import pytest
import pyvista
import torch
from designs import plane, sphere

from rbfevo import advise
from rbfevo.advice import study
from rbfevo.advice.choice import Trial, choose, reasons
from rbfevo.errors import UserError
from rbfevo.figures import advice as figure
from rbfevo.methods.candidates import grid_candidates
from rbfevo.methods.nested import _Screen, nested
from rbfevo.methods.ols import ols
from rbfevo.recorded.advice import read_advice
from rbfevo.scoring.bounded import BoundedPotential
from rbfevo.scoring.gram import kernel_columns
from rbfevo.scoring.kernels import Wendland


def bounded_on(p: float, weighted: bool = False, blend: torch.Tensor | None = None) -> BoundedPotential:
    design = sphere(2, weighted=weighted)
    return BoundedPotential(design.vertices, design.gradient, Wendland(0.9), p, design.weights, blend)


def picks(bounded: BoundedPotential, per_axis: int, count: int, tried: int) -> list[int]:
    columns = kernel_columns(bounded.vertices, Wendland(0.9))
    box = torch.full((3,), -1.0, dtype=torch.float64), torch.full((3,), 1.0, dtype=torch.float64)
    return nested(bounded, columns, lambda c: c, grid_candidates(*box, per_axis), count, tried).indices.tolist()


@pytest.mark.parametrize("p", [4.0, 16.0])
@pytest.mark.parametrize("held", [False, True])
def test_a_nested_sequence_takes_what_raises_bounded_potential_most(p: float, held: bool) -> None:
    """Against plain loops over all candidates, each scored from nothing."""
    blend = None
    if held:
        blend = (bounded_on(p).vertices[:, 0] + 0.4).clamp(0.0, 1.0)
    bounded = bounded_on(p, weighted=True, blend=blend)
    box = torch.full((3,), -1.0, dtype=torch.float64), torch.full((3,), 1.0, dtype=torch.float64)
    grid = grid_candidates(*box, 4)
    expected: list[int] = []
    for _ in range(3):
        setups = torch.stack([torch.stack([grid[i] for i in (*expected, c)]) for c in range(len(grid))])
        values = bounded.values(setups, gap=0.0)
        values[expected] = -1.0
        expected.append(int(torch.nonzero(values >= values.max() - 1e-9)[0]))
    assert picks(bounded, 4, 3, tried=len(grid)) == expected


def test_the_sequence_for_p_2_is_that_of_orthogonal_least_squares() -> None:
    design = plane(20, 20, k=2)
    columns, box = (
        kernel_columns(design.vertices, Wendland(0.7)),
        (torch.zeros(2).double(), torch.tensor([1.0, 2.0]).double()),
    )
    grid = grid_candidates(*box, 6)
    bounded = BoundedPotential(design.vertices, design.gradient, Wendland(0.7), 2.0)
    found = nested(bounded, columns, lambda c: c, grid, 4, tried=len(grid))
    picked = ols(columns, grid, design.gradient, 4)
    assert found.indices.tolist() == picked.indices.tolist()
    torch.testing.assert_close(found.potential, picked.gains.cumsum(0), rtol=1e-7, atol=0.0)


def test_the_screening_promises_no_more_than_there_is_and_loses_little() -> None:
    bounded = bounded_on(16.0)
    few, every = (picks(bounded, 5, 5, tried) for tried in (8, 125))
    grid = grid_candidates(torch.full((3,), -1.0).double(), torch.full((3,), 1.0).double(), 5)
    gains = [float(bounded.values(grid[torch.tensor(rows)][None])[0]) for rows in (few, every)]
    assert gains[0] > 0.97 * gains[1]


@pytest.mark.parametrize("held", [False, True])
def test_a_promise_is_a_gain_that_the_candidate_does_reach(held: bool) -> None:
    """No more than the optimum with it, and most of what that adds to the gain, for the better half of candidates."""
    blend = (bounded_on(16.0).vertices[:, 0] + 0.4).clamp(0.0, 1.0) if held else None
    bounded = bounded_on(16.0, weighted=True, blend=blend)
    grid = grid_candidates(torch.full((3,), -1.0).double(), torch.full((3,), 1.0).double(), 5)
    before = grid[torch.tensor(picks(bounded, 5, 3, tried=8))]
    found = bounded.optima(before[None], gap=0.0)
    screen = _Screen(bounded, kernel_columns(bounded.vertices, Wendland(0.9)), grid)
    screen.move(before, found.weights[0])
    pulled = screen.columns(before).mT @ screen.left  # at the optimum nothing is left along the columns
    assert float(pulled.abs().max()) < 1e-6 * float((screen.columns(before).mT @ bounded.a).abs().max())
    promise = screen.promise()
    with_each = torch.cat((before.expand(len(grid), -1, -1), grid[:, None]), dim=1)
    exact = bounded.values(with_each, gap=0.0).sqrt() * bounded.dual
    usable = torch.isfinite(promise)
    assert bool((promise[usable] <= exact[usable] * (1.0 + 1e-7)).all())
    start = screen.gain
    assert start == pytest.approx(float(found.values[0]) ** 0.5 * bounded.dual, rel=1e-6)
    rise, most = promise[usable] - start, exact[usable] - start
    better = most >= most.median()
    assert float((rise[better] / most[better]).median()) > 0.85


def test_candidates_that_move_nothing_are_refused_with_their_number() -> None:
    bounded = bounded_on(16.0)
    columns = kernel_columns(bounded.vertices, Wendland(0.9))
    far = torch.tensor([[0.9, 0.0, 0.0], [9.0, 0.0, 0.0], [0.0, 9.0, 0.0]]).double()
    with pytest.raises(UserError, match="only 1 of the 3 candidates move anything, for 2 centers"):
        nested(bounded, columns, lambda c: c, far, 2)


def trial(kernel: str, support: float | None, centers: int, gain: float, lloyd: float = math.nan) -> Trial:
    return Trial(kernel, support, centers, gain, math.nan, lloyd)


TRIALS = [
    *(trial("wendland", 1.0, m, gain) for m, gain in ((4, 0.50), (8, 0.78), (16, 0.90))),
    *(trial("wendland", 2.0, m, gain) for m, gain in ((4, 0.60), (8, 0.862), (16, 0.87))),
    *(trial("wendland", 4.0, m, gain) for m, gain in ((4, 0.59), (8, 0.846), (16, 0.80))),
    *(trial("triharmonic", None, m, gain) for m, gain in ((4, 0.30), (8, 0.861), (16, 0.89))),
]


def test_the_rule_takes_the_fewest_centers_and_then_the_largest_radius() -> None:
    """95 % of 0.90 is 0.855: eight centers; 98 % of 0.862 is 0.8448, which radius 4 reaches."""
    chosen, most = choose(TRIALS)
    assert (most.kernel, most.support, most.centers) == ("wendland", 1.0, 16)
    assert (chosen.kernel, chosen.support, chosen.centers) == ("wendland", 4.0, 8)
    without = [one for one in TRIALS if one.support != 4.0]
    assert choose(without).trial[:3] == ("wendland", 2.0, 8)  # and not the global kernel, which is alike
    assert choose([one for one in without if one.support != 2.0]).trial[:3] == ("triharmonic", None, 8)


def test_lloyds_centers_count_and_setups_without_a_gain_do_not() -> None:
    trials = [
        trial("wendland", 1.0, 2, math.nan, lloyd=0.7),
        trial("wendland", 1.0, 4, 0.71),
        trial("wendland", 2.0, 1, 0.0),
    ]
    assert choose(trials).trial[:3] == ("wendland", 1.0, 2)
    with pytest.raises(UserError, match="none of the setups"):
        choose([trial("wendland", 1.0, 1, 0.0), trial("wendland", 1.0, 2, math.nan)])


def test_the_reasons_are_true_to_the_numbers() -> None:
    trials = [*TRIALS[:-1], trial("triharmonic", None, 16, 0.89), trial("wendland", 4.0, 12, 0.8)]
    trials[7] = trials[7]._replace(lloyd=0.45)
    first, second, third = reasons(trials, choose(trials))
    assert first.startswith("8 centers (wendland, radius 4) reach 94% of the largest gain of all setups tried, 0.900")
    assert first.endswith("that of 16 centers (wendland, radius 1)")
    assert second == "with the same number and radius, centers spread evenly (Lloyd) reach 50%"
    # from 4 centers with radius 2 (half of both): 0.59/0.60 and 0.862/0.60
    assert third.startswith("twice the radius is worth less than twice the centers: from 4 with radius 2, ")
    assert third.endswith("radius 4 brings -2%, and 8 centers +44%")


def test_a_recommendation_at_the_limit_says_so() -> None:
    trials = [trial("wendland", 1.0, m, gain) for m, gain in ((1, 0.3), (2, 0.5), (4, 0.9))]
    assert "4 is the most that was tried; more may gain more: centers=8" in reasons(trials, choose(trials))


def test_numbers_and_radii() -> None:
    assert study.numbers(16) == ([1, 2, 3, 4, 6, 8, 12, 16], [4, 8, 16])
    assert study.numbers(1) == ([1], [1])
    assert study.numbers(7) == ([1, 2, 3, 4, 6, 7], [2, 4, 7])


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A ball whose top is to be pushed in by a wide dent."""
    directory = tmp_path_factory.mktemp("ball")
    ball = pyvista.Icosphere(radius=1.0, nsub=2)
    height = np.asarray(ball.points)[:, 2]
    ball["sens"] = np.column_stack([0.0 * height, 0.0 * height, np.exp(-4.0 * (1.0 - height))])
    ball["low"] = (height < -0.5).astype(float)
    ball.save(directory / "ball.vtp")
    return directory


ARGUMENTS = ("scenario=mesh", "scenario.sensitivity=sens", "scenario.hold=low", "scenario.sensitivity_kind=nodal")


@pytest.fixture(scope="module")
def advised(pushed: Path) -> Path:
    out = pushed / "advice"
    arguments = [*ARGUMENTS, f"scenario.template={pushed / 'ball.vtp'}", "centers=4", f"hydra.run.dir={out}"]
    assert advise.main(arguments) == 0
    return out


def test_a_study_leaves_a_table_a_page_and_a_setup(advised: Path) -> None:
    found = read_advice(advised)
    assert {path.name for path in advised.iterdir()} >= set(advise.RESULTS)
    rows = list(csv.DictReader((advised / "advice.csv").read_text().splitlines()))
    assert len(rows) == len(found.trials)
    assert list(rows[0]) == [
        "kernel",
        "support",
        "centers",
        "nested",
        "optimized",
        "lloyd",
    ]
    kernels = {(trial["kernel"], trial["support"]) for trial in found.trials}
    assert ("triharmonic", None) in kernels
    assert len(kernels) >= 5
    assert found.norm == 16.0
    assert found.smooth == pytest.approx(1.5 * edge_of(advised.parent / "ball.vtp"), rel=1e-3)
    for one in found.trials:  # a nested sequence never loses
        others = [
            two["nested"] for two in found.trials if (two["kernel"], two["support"]) == (one["kernel"], one["support"])
        ]
        assert others == sorted(others)
    for one in found.trials:  # the start of a climb counts too
        if one["optimized"] is not None:
            assert one["optimized"] >= max(one["nested"], one["lloyd"]) - 1e-12
    page = (advised / "advice.html").read_text()
    assert f"<h1>{found.chosen['centers']} center" in page
    assert "http" not in page.split("<script>")[0]
    assert figure.picture(found).axes[0].get_xlabel() == "number of centers"


def edge_of(path: Path) -> float:
    mesh = pyvista.read(path)
    corners = np.asarray(mesh.points)[np.asarray(mesh.faces).reshape(-1, 4)[:, 1:]]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())


def test_the_setup_has_the_gain_that_is_reported(advised: Path) -> None:
    """Against `BoundedPotential.definition` on all vertices, the sensitivity smoothed as the command says."""
    from rbfevo.scenarios import mesh

    found = read_advice(advised)
    scenario = mesh(
        str(advised.parent / "ball.vtp"), sensitivity="sens", sensitivity_kind="nodal", hold="low", smooth=found.smooth
    )
    centers = torch.from_numpy(np.loadtxt(advised / "centers.csv", delimiter=",", skiprows=1, ndmin=2))
    assert len(centers) == found.chosen["centers"]
    if found.chosen["support"] is None:
        pytest.fail("a wide dent wants a compact kernel here")
    bounded = BoundedPotential(
        scenario.vertices, scenario.gradient, Wendland(found.chosen["support"]), 16.0, scenario.weights, scenario.blend
    )
    assert math.sqrt(float(bounded.definition(centers[None])[0])) == pytest.approx(found.chosen["gain"], abs=1e-5)


def test_the_commands_run_as_they_stand(advised: Path, capsys: pytest.CaptureFixture[str]) -> None:
    import shlex

    from rbfevo import export
    from rbfevo.__main__ import main

    run, exported = read_advice(advised).commands
    arguments = shlex.split(run)
    assert arguments[:3] == ["python", "-m", "rbfevo"]
    assert "manipulation=direct" in arguments
    assert f"scenario.smooth={read_advice(advised).smooth:.4g}" in arguments
    small = [
        "method.generations=4",
        "method.starts=16",
        "method.population=16",
        "method.polish=1",
        "figures=false",
        "quiet=true",
    ]
    assert main([*arguments[3:], *small]) == 0
    arguments = shlex.split(exported)
    assert arguments[:3] == ["python", "-m", "rbfevo.export"]
    assert export.main(arguments[3:]) == 0
    summary = json.loads((advised / "run" / "summary.json").read_text())
    assert summary["criterion_norm"] == 16.0
    assert summary["centers"] == read_advice(advised).chosen["centers"]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["-m", "centers=2,3"], "one design at a time"),
        (["scenario.template=none.vtp", "scenario.sensitivity=sens"], "none.vtp"),
        (["scenario.template=BALL", "scenario.sensitivity=other"], "other"),
        (["scenario.template=BALL", "scenario.sensitivity=sens", "kernel=spline"], "choose one of"),
    ],
)
def test_mistakes_are_one_line(pushed: Path, more: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [argument.replace("BALL", str(pushed / "ball.vtp")) for argument in more]
    assert advise.main(["scenario=mesh", *arguments, f"hydra.run.dir={pushed / 'bad'}"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert "Traceback" not in error


def test_results_are_not_overwritten(advised: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = (advised / "advice.json").read_bytes()
    arguments = [*ARGUMENTS, f"scenario.template={advised.parent / 'ball.vtp'}", f"hydra.run.dir={advised}"]
    assert advise.main(arguments) == 2
    assert "advice.json" in capsys.readouterr().err
    assert (advised / "advice.json").read_bytes() == before


def test_smooth_null_leaves_the_sensitivity_raw(pushed: Path) -> None:
    out = pushed / "raw"
    arguments = [*ARGUMENTS, f"scenario.template={pushed / 'ball.vtp'}", "centers=1", "kernel.support=0.8"]
    more = ["scenario.smooth=null", "figures=false", "quiet=true", f"hydra.run.dir={out}"]
    assert advise.main([*arguments, *more]) == 0
    found = read_advice(out)
    assert found.smooth is None
    assert "smooth" not in found.commands[0]


def test_a_target_is_judged_by_the_papers_potential(tmp_path: Path) -> None:
    """And one radius alone where one is asked for, with nothing smoothed."""
    arguments = [
        "scenario=plane",
        "kernel=wendland",
        "kernel.support=0.5",
        "centers=3",
        f"hydra.run.dir={tmp_path / 'a'}",
    ]
    assert advise.main([*arguments, "figures=false", "quiet=true"]) == 0
    found = read_advice(tmp_path / "a")
    assert (found.norm, found.smooth) == (2.0, None)
    assert {(trial["kernel"], trial["support"]) for trial in found.trials} == {("wendland", 0.5)}
    assert not (tmp_path / "a" / "advice.html").exists()
    assert "--rule" not in found.commands[1]
    assert "criterion.norm=2" in found.commands[0]
