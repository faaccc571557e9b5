"""`scenario.sensitivity=[...]`: several objectives of one design, searched for the mean or the least of their P."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
import torch

from rbfevo import export
from rbfevo.__main__ import main
from rbfevo.recorded.moves import RULES, wanted_move
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import setup
from rbfevo.runs import run
from rbfevo.scoring.combination import Combination
from tests.test_contracts import METHODS, option, settings
from tests.test_given import HALF, table
from tests.test_mesh_runs import SUPPORT, egg

SHARES = np.array([2.0, 1.0]) / 3.0


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = egg(tmp_path_factory.mktemp("egg"))
    x = np.asarray(pv.read(path).points, np.float64)
    lift = np.column_stack([np.sin(2.0 * x[:, 2]), 0.3 * x[:, 1], np.cos(1.5 * x[:, 0])])
    np.save(path.parent / "lift.npy", 5.0 * lift)
    return path


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def asked(out: Path, template: Path, *more: str, both: bool = True) -> list[str]:
    """The command line of a run; the first objective is minimized and counts twice, the second is maximized."""
    names = [str(template.parent / name) for name in ("s.npy", "lift.npy")]
    sensitivity = [f"scenario.sensitivity=[{','.join(names)}]"] if both else []
    weighed = ["scenario.objective=[minimize,maximize]", "scenario.objective_weights=[2,1]"] if both else []
    mesh = ["scenario=mesh", f"scenario.template={template}", "scenario.symmetry=y", "scenario.symmetry_at=0"]
    return [f"hydra.run.dir={out}", *mesh, *sensitivity, *weighed, f"kernel.support={SUPPORT}", "quiet=true", *more]


def given(tmp_path: Path) -> list[str]:
    return ["method=given", f"method.centers={table(tmp_path / 'mine.csv', HALF, 'x,y,z')}"]


def overrides(method: str) -> list[str]:
    return [f"method={method}", *(f"method.{key}={value}" for key, value in METHODS[method].items())]


def potential(record: Record, row: int, g: np.ndarray) -> float:
    """P of a field [n, 3] of unit norm by plain least squares."""
    chosen, left = setup(record, row), 0.0
    roots = np.sqrt(record.weights)[:, None]
    for components, across, columns in chosen.parities(3):
        U = roots * chosen.blended(record.vertices, across)[:, columns]
        wanted = roots * g[:, components]
        left += np.square(wanted - U @ np.linalg.lstsq(U, wanted, rcond=None)[0]).sum()
    return 1.0 - float(left)


def test_fields_are_those_of_each_alone_and_stacked_by_their_shares(template: Path, tmp_path: Path) -> None:
    assert main(asked(tmp_path / "both", template, *given(tmp_path))) == 0
    record = read(tmp_path / "both")
    assert record.gradients is not None
    for index, (name, way) in enumerate((("s.npy", "minimize"), ("lift.npy", "maximize"))):
        alone = [f"scenario.sensitivity={template.parent / name}", f"scenario.objective={way}"]
        assert main(asked(tmp_path / name, template, *given(tmp_path), *alone, both=False)) == 0
        single = read(tmp_path / name)
        np.testing.assert_allclose(record.gradients[index], single.gradient, atol=1e-12)
        assert record.potentials is not None
        np.testing.assert_allclose(record.potentials[:, index], single.improvement_potential, atol=1e-10)
        assert single.gradients is None
    stacked = np.concatenate([np.sqrt(share) * g for share, g in zip(SHARES, record.gradients, strict=True)], axis=1)
    np.testing.assert_allclose(record.gradient, stacked, atol=1e-12)
    assert record.objectives == ("s", "lift")


def test_one_in_a_list_is_that_one(template: Path, tmp_path: Path) -> None:
    for name, value in (("a", f"{template.parent / 's.npy'}"), ("b", f"[{template.parent / 's.npy'}]")):
        more = [*given(tmp_path), f"scenario.sensitivity={value}"]
        assert main(asked(tmp_path / name, template, *more, both=False)) == 0
    for file in ("scenario.npz", "setups.npz"):
        one, other = (dict(np.load(tmp_path / name / file)) for name in ("a", "b"))
        assert one.keys() == other.keys()
        for key in one:
            np.testing.assert_array_equal(one[key], other[key])


@pytest.mark.parametrize("method", [name for name in METHODS if name != "given"])
@pytest.mark.parametrize("combine", ["mean", "worst"])
def test_every_method_saves_the_potential_of_each(method: str, combine: str, template: Path, tmp_path: Path) -> None:
    more = [] if combine == "mean" else ["scenario.combine=worst", "scenario.objective_weights=null"]
    assert main(asked(tmp_path / "run", template, *overrides(method), "centers=4", *more)) == 0
    record = read(tmp_path / "run")
    assert record.gradients is not None
    assert record.potentials is not None
    for row in (0, len(record.centers) - 1):
        found = [potential(record, row, g) for g in record.gradients]
        np.testing.assert_allclose(record.potentials[row], found, atol=1e-8)
    shares = SHARES if combine == "mean" else np.array([0.5, 0.5])
    np.testing.assert_allclose(record.improvement_potential, record.potentials @ shares, atol=1e-8)
    if combine == "worst":
        assert record.worst_potential is not None
        np.testing.assert_allclose(record.worst_potential, record.potentials.min(1), atol=1e-12)
        objectives = np.column_stack([record.regularity, record.worst_potential])
    else:
        assert record.worst_potential is None
        objectives = np.column_stack([record.regularity, record.improvement_potential])
    better = (objectives[:, None] >= objectives).all(2) & (objectives[:, None] > objectives).any(2)
    np.testing.assert_array_equal(record.nondominated, ~better.any(0))
    text = (tmp_path / "run" / "setups.csv").read_text().splitlines()[0]
    assert "potential_s" in text
    assert "potential_lift" in text


def test_ols_raises_what_is_searched_the_most(template: Path, tmp_path: Path) -> None:
    found = {}
    for combine in ("mean", "worst"):
        more = [*overrides("ols"), "centers=2", f"scenario.combine={combine}", "scenario.objective_weights=null"]
        assert main(asked(tmp_path / combine, template, *more)) == 0
        record = read(tmp_path / combine)
        assert record.potentials is not None
        found[combine] = record.potentials[record.method == "ols"][0]
    assert found["worst"].min() >= found["mean"].min() - 1e-9
    assert found["mean"].mean() >= found["worst"].mean() - 1e-9


@pytest.mark.parametrize("combine", ["mean", "worst"])
def test_bounded_potential_of_each_is_that_of_a_run_of_its_own(combine: str, template: Path, tmp_path: Path) -> None:
    more = [*given(tmp_path), "criterion.norm=16", f"scenario.combine={combine}"]
    more += ["scenario.objective_weights=null"] if combine == "worst" else []
    assert main(asked(tmp_path / "both", template, *more)) == 0
    record = read(tmp_path / "both")
    each = []
    for name, way in (("s.npy", "minimize"), ("lift.npy", "maximize")):
        alone = [f"scenario.sensitivity={template.parent / name}", f"scenario.objective={way}", "criterion.norm=16"]
        assert main(asked(tmp_path / name, template, *given(tmp_path), *alone, both=False)) == 0
        each.append(read(tmp_path / name).bounded_potential)
    assert record.bounded_potentials is not None
    np.testing.assert_allclose(record.bounded_potentials, np.column_stack(each), atol=1e-8)
    wanted = record.bounded_potentials.min(1) if combine == "worst" else record.bounded_potentials @ SHARES
    np.testing.assert_allclose(record.potential, wanted, atol=1e-12)


@pytest.mark.parametrize("combine", ["mean", "worst"])
@pytest.mark.parametrize("norm", [2.0, 16.0])
def test_gradients_are_those_of_differences(combine: str, norm: float, template: Path) -> None:
    names = [str(template.parent / name) for name in ("s.npy", "lift.npy")]
    node = {**option("scenario", "mesh"), "template": str(template), "sensitivity": names, "support": SUPPORT}
    node |= {"symmetry": "y", "symmetry_at": 0.0, "combine": combine}
    problem = run.Run(settings("gradient", centers=2, scenario=node, criterion_norm=norm)).problem()
    points = torch.tensor([[[0.4, 0.5, 0.3], [-1.1, 0.6, -0.4]]], dtype=torch.float64)
    spectrum = problem.spectrum(points)
    found = spectrum.backward(torch.zeros_like(spectrum.sigma), torch.ones(1, dtype=torch.float64))
    for index in np.ndindex(2, 3):
        values = []
        for sign in (1.0, -1.0):
            moved = points.clone()
            moved[(0, *index)] += sign * 1e-5
            values.append(float(problem.evaluate(moved).improvement_potential[0]))
        assert float(found[(0, *index)]) == pytest.approx((values[0] - values[1]) / 2e-5, abs=5e-5)


def test_combinations_by_value() -> None:
    P = torch.tensor([[0.2, 0.8], [0.9, 0.5]], dtype=torch.float64)
    mean, worst = Combination((0.75, 0.25)), Combination((0.5, 0.5), worst=True)
    torch.testing.assert_close(mean(P), torch.tensor([0.35, 0.8], dtype=torch.float64))
    torch.testing.assert_close(worst(P), torch.tensor([0.2, 0.5], dtype=torch.float64))
    torch.testing.assert_close(worst.slopes(P), torch.tensor([[1.0, 0.0], [0.0, 1.0]], dtype=torch.float64))
    value, slopes = worst.smooth(P, 16.0)
    residual = 1.0 - P
    torch.testing.assert_close(value, 1.0 - (residual**16).mean(1) ** (1 / 16))
    assert bool((value >= worst(P)).all())
    leaf = P.clone().requires_grad_()
    (1.0 - ((1.0 - leaf) ** 16).mean(1) ** (1 / 16)).sum().backward()
    torch.testing.assert_close(slopes, leaf.grad)


@pytest.mark.parametrize("rule", RULES)
def test_a_step_that_keeps_an_objective_does_not_make_it_worse(
    rule: str, template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(asked(tmp_path / "run", template, *given(tmp_path))) == 0
    record = read(tmp_path / "run")
    chosen = setup(record, 0)
    capsys.readouterr()
    raw = {name: np.load(template.parent / f"{name}.npy") for name in ("s", "lift")}
    for followed, kept in (("s", "lift"), ("lift", "s")):
        free = wanted_move(record, chosen, 0.02, rule, followed)
        move = wanted_move(record, chosen, 0.02, rule, followed, [kept])
        by_name = {change.name: change for change in move.changes}
        for name, way in (("s", -1.0), ("lift", 1.0)):
            change = float((raw[name] * move.reached).sum())
            assert by_name[name].value == pytest.approx(change, rel=1e-9, abs=1e-9 * np.abs(raw[name]).sum() * 0.1)
            assert by_name[name].gain == 0.0 or (way * change > 0) == (by_name[name].gain > 0)
        loss = float((raw[kept] * free.reached).sum()) * (1.0 if kept == "s" else -1.0)
        size = float(np.abs(raw[kept] * move.reached).sum())
        now = float((raw[kept] * move.reached).sum()) * (1.0 if kept == "s" else -1.0)
        assert now <= 1e-9 * size
        assert by_name[followed].gain > 0
        if loss <= 0:  # nothing to keep
            np.testing.assert_allclose(move.reached, free.reached, atol=1e-12)
        else:
            assert abs(now) <= 1e-9 * size
    assert export.main([str(tmp_path / "run"), "--pick", "index:0", "--rule", rule, "--keep", "lift"]) == 0
    printed = capsys.readouterr().out
    assert "predicted change of s:" in printed
    assert "predicted change of lift:" in printed
    assert (
        export.main([str(tmp_path / "run"), "--pick", "index:0", "--out", str(tmp_path / "x"), "--keep", "drag"]) == 2
    )
    line = capsys.readouterr().err
    assert "s" in line
    assert "lift" in line


def test_what_does_not_fit_gets_one_line(template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*more: str) -> str:
        assert main(asked(tmp_path / "no", template, "method=random", *more)) == 2
        line = capsys.readouterr().err.strip()
        assert "\n" not in line
        return line

    assert "3" in refused("scenario.objective_weights=[1,2,3]")
    assert "objective" in refused("scenario.objective=[minimize,minimize,maximize]")
    assert "combine" in refused("scenario.combine=median")
    assert refused("scenario.objective_weights=[1,-1]")
    assert refused(f"scenario.sensitivity=[{template.parent / 's.npy'},{template.parent / 's.npy'}]")
