"""`scenario.max_displacement`: steps keep to it, and bounded potential is that of displacements within it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
import torch

from rbfevo import export
from rbfevo.__main__ import main
from rbfevo.recorded.moves import RULES, wanted_move
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import setup
from rbfevo.runs.config import build
from rbfevo.scenarios.coarse import coarsened
from rbfevo.scoring.bounded import BoundedPotential
from rbfevo.scoring.representations import RBF
from tests.designs import certified_potential, scipy_potential
from tests.test_contracts import METHODS, option
from tests.test_given import HALF, on_egg, table
from tests.test_mesh_runs import egg


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return egg(tmp_path_factory.mktemp("egg"))


@pytest.fixture(autouse=True)
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rbfevo.figures.draw", lambda run: [])


def design(seed: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    drawn = torch.Generator().manual_seed(seed)
    X = torch.rand(120, 3, generator=drawn, dtype=torch.float64)
    g = torch.randn(120, 3, generator=drawn, dtype=torch.float64)
    weights = 0.5 + torch.rand(120, generator=drawn, dtype=torch.float64)
    most = torch.where(X[:, 0] < 0.4, 0.01, 0.02 + 0.05 * X[:, 1])
    return X, g, weights, most


def representation() -> RBF:
    return RBF(build(option("kernel", "wendland"), 3, 0.8, 2.0))


@pytest.mark.parametrize("p", [2.0, 4.0, 16.0])
def test_bounded_potential_is_that_of_lengths_in_units_of_the_bounds(p: float) -> None:
    X, g, weights, most = design()
    setups = torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    bounded = BoundedPotential(X, g, representation(), p, weights, None, most=most)
    fast, defined = bounded.values(setups, gap=0.0), bounded.definition(setups)
    u = (weights / weights.sum()).numpy()
    for row in range(3):
        Phi = representation().phi(X, setups[row]).numpy() / most.numpy()[:, None]
        blocks = [([0, 1, 2], Phi)]
        field = g.numpy() * most.numpy()[:, None]
        below, above = certified_potential(blocks, field, u, p)
        assert below - 1e-10 <= float(fast[row]) <= above + 1e-10
        assert float(defined[row]) == pytest.approx(float(fast[row]), abs=1e-10)
        assert float(fast[row]) == pytest.approx(scipy_potential(blocks, field, u, p), abs=1e-5)
    plain = BoundedPotential(X, g, representation(), p, weights)
    assert float((fast - plain.values(setups, gap=0.0)).abs().min()) > 1e-3
    alike = BoundedPotential(X, g, representation(), p, weights, None, most=torch.full_like(weights, 0.03))
    torch.testing.assert_close(alike.values(setups), plain.values(setups), rtol=0, atol=0)
    scaled = BoundedPotential(X, g, representation(), p, weights, None, most=7.0 * most)
    torch.testing.assert_close(scaled.values(setups, gap=0.0), fast, rtol=1e-10, atol=0)


def test_its_gradient_is_that_of_differences() -> None:
    X, g, weights, most = design()
    blend = (X[:, 2] / 0.3).clamp(max=1.0)
    bounded = BoundedPotential(X, g, representation(), 16.0, weights, blend, most=most)
    setups = torch.rand(1, 3, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    _, found = bounded.values_and_gradients(setups)
    for index in np.ndindex(3, 3):
        values = []
        for sign in (1.0, -1.0):
            moved = setups.clone()
            moved[(0, *index)] += sign * 1e-5
            values.append(float(bounded.values(moved, gap=0.0)[0]))
        assert float(found[(0, *index)]) == pytest.approx((values[0] - values[1]) / 2e-5, abs=1e-6)


def bounds(template: Path) -> Path:
    """Bounds that are narrow at one end of the egg, as a file; that end moves by less than a hundredth of the other."""
    x = np.asarray(pv.read(template).points)[:, 0]
    path = template.parent / "most.npy"
    np.save(path, np.where(x < 0, 0.002, 0.3))
    return path


def run_on_egg(out: Path, template: Path, *more: str) -> Record:
    file = table(out.parent / "five.csv", HALF, "x,y,z")
    assert main(on_egg(out, template, file, *more)) == 0
    return read(out)


def test_a_run_saves_bounds_and_the_gain_under_them(template: Path, tmp_path: Path) -> None:
    record = run_on_egg(
        tmp_path / "run", template, "criterion.norm=16", f"scenario.max_displacement={bounds(template)}"
    )
    assert record.max_displacement is not None
    np.testing.assert_array_equal(record.max_displacement, np.where(record.vertices[:, 0] < 0, 0.002, 0.3))
    assert "0.002 to 0.3" in record.summary["notes"]["max displacement"]
    chosen = setup(record, 0)
    most = record.max_displacement[:, None]
    blocks = [
        (components.tolist(), chosen.columns(record.vertices, across)[:, columns] / most)
        for components, across, columns in chosen.parities(3)
    ]
    u = record.weights / record.weights.sum()
    below, above = certified_potential(blocks, record.gradient * most, u, 16.0)
    assert record.bounded_potential is not None
    assert below - 1e-8 <= record.bounded_potential[0] <= above + 1e-8
    plain = run_on_egg(tmp_path / "plain", template, "criterion.norm=16")
    assert plain.bounded_potential is not None
    assert abs(plain.bounded_potential[0] - record.bounded_potential[0]) > 1e-3
    alike = run_on_egg(tmp_path / "alike", template, "criterion.norm=16", "scenario.max_displacement=2%")
    np.testing.assert_array_equal(alike.bounded_potential, plain.bounded_potential)
    np.testing.assert_array_equal(alike.improvement_potential, record.improvement_potential)  # P knows no bounds


def test_searches_see_the_bounds(template: Path, tmp_path: Path) -> None:
    found = []
    for name, more in (("bounds", [f"scenario.max_displacement={bounds(template)}"]), ("plain", [])):
        for method in ("ols", "gradient"):
            keys = [f"method={method}", *(f"method.{key}={value}" for key, value in METHODS[method].items())]
            out = tmp_path / f"{name}-{method}"
            assert main(on_egg(out, template, None, *keys, "centers=3", "criterion.norm=16", *more)) == 0
            found.append(read(out).centers[-1])
    assert not np.allclose(found[0], found[2])
    assert not np.allclose(found[1], found[3])
    assert found[0][:, 0].mean() > 0.0  # where vertices may move


@pytest.mark.parametrize("rule", RULES)
def test_a_step_keeps_to_the_bounds_and_uses_them(
    rule: str, template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = run_on_egg(tmp_path / "run", template, f"scenario.max_displacement={bounds(template)}")
    plain = run_on_egg(tmp_path / "plain", template)
    most = record.max_displacement
    assert most is not None
    chosen = setup(record, 0)
    step = 0.05
    diagonal = float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
    free = wanted_move(plain, chosen, step, rule)
    assert (np.linalg.norm(free.reached, axis=1) > most).any()
    capsys.readouterr()
    assert export.main([str(tmp_path / "run"), "--pick", "index:0", "--step", str(step), "--rule", rule]) == 0
    printed = capsys.readouterr().out
    made: Any = pv.read(tmp_path / "run" / "export-index-0" / "template.vtp")
    lengths = np.linalg.norm(made["reached"], axis=1)
    assert (lengths <= most * (1 + 1e-12)).all()
    assert (lengths <= step * diagonal * (1 + 1e-12)).all()
    at_bound = int((lengths >= 0.99 * most).sum())
    limited = f"shorter than --step, since {at_bound} vertices move by as much as they may" in printed
    assert limited == (lengths.max() < step * diagonal * (1 - 1e-9))
    assert limited or rule == "max-norm"  # which may use all of the step at the wide end and not break the bounds
    assert (lengths / np.minimum(most, step * diagonal)).max() == pytest.approx(1.0, abs=1e-12)
    move = wanted_move(record, chosen, step, rule)
    np.testing.assert_allclose(move.reached, made["reached"], atol=1e-12)
    assert move.change is not None
    assert move.change < 0
    if rule == "max-norm":  # which looks for the best within the bounds, and does better than scaling a free step
        scale = float((most / np.maximum(np.linalg.norm(free.reached, axis=1), 1e-300)).min())
        assert move.change < 1.3 * scale * (free.change or 0.0)
        for other in RULES[1:]:
            assert move.change < (wanted_move(record, chosen, step, other).change or 0.0)
    short = wanted_move(record, chosen, 1e-5, rule)
    assert short.limited == 0
    assert np.linalg.norm(short.reached, axis=1).max() == pytest.approx(1e-5 * diagonal)


def test_an_approximation_of_a_target_is_scaled_down(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ball: Any = pv.Icosphere(radius=1.0, nsub=3)
    ball.save(tmp_path / "ball.ply")
    ball.scale([1.5, 1.0, 1.0]).save(tmp_path / "target.ply")
    asked = [
        "scenario=mesh",
        f"scenario.template={tmp_path / 'ball.ply'}",
        f"scenario.target={tmp_path / 'target.ply'}",
    ]
    asked += ["method=lloyd", "centers=8", "quiet=true", f"hydra.run.dir={tmp_path / 'run'}"]
    assert main([*asked, "scenario.max_displacement=0.1"]) == 0
    capsys.readouterr()
    assert export.main([str(tmp_path / "run"), "--pick", "index:0"]) == 0
    assert "the best approximation is scaled down, since" in capsys.readouterr().out
    made: Any = pv.read(tmp_path / "run" / "export-index-0" / "template.vtp")
    assert np.linalg.norm(made["reached"], axis=1).max() == pytest.approx(0.1)


def test_coarse_designs_keep_the_mean_of_the_bounds(template: Path) -> None:
    node = {**option("scenario", "mesh"), "template": str(template), "sensitivity": str(template.parent / "s.npy")}
    scenario = build({**node, "max_displacement": str(bounds(template))})
    coarse = coarsened(scenario, 100)
    assert coarse.max_displacement is not None
    whole, fewer = ((s.weights * s.max_displacement).sum() for s in (scenario, coarse))
    torch.testing.assert_close(whole, fewer)
    left = coarse.vertices[:, 0] < -1.0
    torch.testing.assert_close(coarse.max_displacement[left], torch.full_like(coarse.weights[left], 0.002))
    half = build({**node, "max_displacement": str(bounds(template)), "symmetry": "y", "symmetry_at": 0.0}).half()
    assert half.max_displacement is not None
    assert len(half.max_displacement) == len(half.vertices) < len(scenario.vertices)


def test_bounds_that_are_none_get_one_line(template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*more: str) -> str:
        assert main(on_egg(tmp_path / "no", template, None, "method=random", *more)) == 2
        line = capsys.readouterr().err.strip()
        assert "\n" not in line
        return line

    zero = np.load(bounds(template))
    zero[:3] = [0.0, -1.0, 0.0]
    np.save(tmp_path / "zero.npy", zero)
    line = refused(f"scenario.max_displacement={tmp_path / 'zero.npy'}")
    assert "3 of" in line
    assert "no bound above 0; hold those that cannot move by scenario.hold" in line
    assert "give a positive number" in refused("scenario.max_displacement=0")
    assert "max_displacement" in refused("scenario.max_displacement=nothing")
    assert "it has 3 values per vertex" in refused(f"scenario.max_displacement={template.parent / 's.npy'}")
