"""The unions of fronts: what is kept of all sources, and what is compared with them; growth's clock and exponents."""

from __future__ import annotations

import math
import time
from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks import growth, unions
from benchmarks.panels import PANELS
from benchmarks.unions import Compared, Union, empty, misses
from rbfevo.runs.run import Run
from rbfevo.scoring.pareto import nondominated


def column(values: list[float], m: int = 25) -> Tensor:
    """Setups [p, m, 2] that tell each other apart."""
    return torch.tensor(values, dtype=torch.float64)[:, None, None].expand(-1, m, 2)


def test_a_union_keeps_what_no_source_dominates(tmp_path: Path) -> None:
    first = torch.tensor([[0.1, 0.9], [0.5, 0.5], [0.4, 0.4]], dtype=torch.float64)
    second = torch.tensor([[0.9, 0.1], [0.6, 0.6]], dtype=torch.float64)
    held = (
        empty(PANELS[0]).with_setups(column([1.0, 2.0, 3.0]), first, "a").with_setups(column([4.0, 5.0]), second, "b")
    )
    held = held.with_setups(column([6.0]), torch.tensor([[0.05, 0.05]], dtype=torch.float64), "c")
    assert held.objectives.tolist() == [[0.1, 0.9], [0.6, 0.6], [0.9, 0.1]]
    assert held.centers[:, 0, 0].tolist() == [1.0, 5.0, 4.0]
    assert held.source.tolist() == [0, 1, 1]
    assert held.sources == ("a", "b", "c")
    assert Union.read(PANELS[0], tmp_path) is None
    held.write(PANELS[0], tmp_path)
    again = Union.read(PANELS[0], tmp_path)
    assert again is not None
    assert again.sources == held.sources
    assert all(torch.equal(one, other) for one, other in zip(again[:3], held[:3], strict=True))


def test_a_source_is_computed_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.setitem(unions.GROUPS, "heuristics", ("method=lloyd seed=1", "method=lloyd seed=2"))
    unions.add(PANELS[0], ["heuristics"], tmp_path)
    held = Union.read(PANELS[0], tmp_path)
    assert held is not None
    assert held.sources == ("method=lloyd seed=1", "method=lloyd seed=2")
    run = Run(PANELS[0].settings("method=lloyd", "seed=2"))
    (search,) = run.stages
    search.start(run.problem())
    search.step()
    exact = run.evaluator.definition(search.rows()[0].centers).objectives
    both = torch.cat((held.objectives, exact))
    assert bool(nondominated(both)[: len(held.objectives)].all())
    assert float((held.objectives - exact).abs().sum(1).min()) < 1e-12 or not bool(nondominated(both)[-1])
    monkeypatch.setattr(unions, "setups_of_run", lambda *_: pytest.fail("it is there"))
    unions.add(PANELS[0], ["heuristics"], tmp_path)
    assert len(capsys.readouterr().out.splitlines()) == 2


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: panel.name)
def test_committed_unions_are_scored_by_the_definition(panel) -> None:
    held = Union.read(panel)
    if held is None:
        pytest.skip(f"{panel.name} has no union yet")
    assert bool(nondominated(held.objectives).all())
    assert bool((held.objectives[1:, 0] > held.objectives[:-1, 0]).all())
    assert set(held.source.tolist()) <= set(range(len(held.sources)))
    rows = [0, len(held.centers) // 2, -1]
    exact = Run(panel.settings()).evaluator.definition(held.centers[rows]).objectives
    torch.testing.assert_close(held.objectives[rows], exact, rtol=1e-6, atol=1e-9)
    assert float((held.objectives[-1] / held.objectives.amax(0))[0]) == 1.0


def test_medians_are_held_against_the_targets() -> None:
    def front(share: float, regularity: float, potential: float) -> Compared:
        return Compared("panel", 0, share, regularity, potential, 1.0)

    assert misses([front(0.990, 1.0, 1.0), front(0.996, 0.998, 0.9975), front(0.997, 0.99, 0.9972)]) == []
    missed = misses([front(0.9949, 1.0, 0.9969), front(1.0, 0.99, 1.0), front(0.99, 1.0, 0.99)])
    assert missed == ["hypervolume 0.9949", "best_improvement_potential 0.9969"]


def test_exponents_are_slopes() -> None:
    points = [growth.Point("c", size, 3.0 * size**1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0) for size in (10, 40, 90)]
    first, *others = growth.exponents(points)
    assert math.isnan(first)
    assert others == pytest.approx([1.5, 1.5])


def test_nested_calls_are_counted_once() -> None:
    class Work:
        def outer(self) -> None:
            time.sleep(0.02)
            self.inner()

        def inner(self) -> None:
            time.sleep(0.05)

    clock = growth.Clock()
    clock.watch(Work, "outer", "outer")
    clock.watch(Work, "inner", "inner")
    begin = time.perf_counter()
    Work().outer()
    Work().inner()
    spent = time.perf_counter() - begin
    assert clock.seconds["inner"] >= 0.1
    assert clock.seconds["outer"] >= 0.02
    assert clock.seconds["inner"] + clock.seconds["outer"] <= spent
