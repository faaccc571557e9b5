"""What every option of a group keeps: yaml and signature agree; contracts of methods, representations and kernels."""

from __future__ import annotations

import dataclasses
import inspect
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from rbfevo.figures.series import HEURISTICS
from rbfevo.methods.cmaes.algorithm import CMAES
from rbfevo.methods.nsga2 import NSGA2
from rbfevo.recorded.record import read
from rbfevo.runs import run
from rbfevo.runs.config import CONF, Settings, build, target_of
from rbfevo.runs.identity import identity
from rbfevo.runs.journal import Journal
from rbfevo.scenarios import plane
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.kernels import Kernel, kernel_of
from rbfevo.scoring.representations import Pull, Representation, representation_of

GROUPS = ("scenario", "kernel", "representation", "method")
OPTIONS = [(group, path.stem) for group in GROUPS for path in sorted((CONF / group).glob("*.yaml"))]
BEFORE = "7673209e82a192b516b5cdac"  # of `settings("nsga2")`, by a version of before `criterion.norm`
GIVEN = Path(__file__).with_name("given")  # control points for the plane, in files
METHODS: dict[str, dict[str, Any]] = {  # small budgets
    "blend": {"climbs": 4, "per_axis": 8},
    "cmaes": {"parents": 4, "population": 8, "generations": 3},
    "gradient": {"starts": 16, "population": 16, "generations": 6, "polish": 2, "front": 6, "coarse": 100},
    "given": {"centers": [str(GIVEN / "four.csv"), str(GIVEN / "four_others.csv")]},
    "lloyd": {"starts": 2},
    "nsga2": {"population": 12, "generations": 3},
    "ols": {"per_axis": 6},
    "random": {"population": 5},
}


def option(group: str, name: str) -> dict[str, Any]:
    return yaml.safe_load((CONF / group / f"{name}.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize(("group", "name"), OPTIONS, ids=[f"{group}-{name}" for group, name in OPTIONS])
def test_defaults_of_yaml_and_signature_are_equal(group: str, name: str) -> None:
    node = option(group, name)
    target = target_of(node["_target_"])
    parameters = inspect.signature(target).parameters
    for key, value in node.items():
        if key in ("_target_", "defaults") or isinstance(value, dict):
            continue
        assert key in parameters, f"{name}.yaml has {key}, which its target does not take"
        default = parameters[key].default
        if default is inspect.Parameter.empty or value == "???":
            continue
        default = list(default) if isinstance(default, tuple) else default
        assert value == default, f"{key} is {value} in {name}.yaml and {default} in the signature"
    free = [key for key, kind in parameters.items() if kind.default is not inspect.Parameter.empty]
    positional = {"default_support", "diagonal"}  # what the run hands in
    if not {"defaults"} & set(node):
        assert set(free) - positional <= set(node), "a key of the signature is missing in the yaml"


def settings(name: str, seed: int = 3, **changes: Any) -> Settings:
    node = {**option("method", name), **METHODS[name]}
    made: dict[str, Any] = {
        "scenario": {"_target_": "rbfevo.scenarios.plane", "resolution": [12, 24], "support": 0.5},
        "kernel": option("kernel", "wendland"),
        "method": node,
        "representation": option("representation", "rbf"),
        "manipulation": "indirect",
        "seed": seed,
        "centers": 4,
        "preferences": None,
        "device": "cpu",
        "evaluator": "eager",
        "figures": False,
        "quiet": True,
        "checkpoint_every": 0.0,
    }
    return Settings(**{**made, **changes})


def test_configurations_and_checkpoints_of_older_runs_are_still_those_of_the_same_run() -> None:
    new = settings("nsga2")
    old = dataclasses.replace(new, kernel={**new.kernel, "_target_": "rbfevo.kernels.wendland"})
    assert target_of("rbfevo.kernels.wendland") is target_of(new.kernel["_target_"])
    assert identity(old) == identity(new)
    assert identity(dataclasses.replace(new, device="cuda", figures=True, checkpoint_every=7.0)) == identity(new)
    assert identity(new) == BEFORE  # written by a version that knew no criterion
    other = {"_target_": "somewhere.else"}
    changes = ({"seed": 4}, {"evaluator": "fused"}, {"representation": other}, {"kernel": other})
    for change in (*changes, {"criterion_norm": 16.0}):
        assert identity(dataclasses.replace(new, **change)) != identity(new)


@pytest.mark.parametrize("method", METHODS)
def test_every_method_stays_in_the_box_and_follows_its_seed(method: str, tmp_path: Path) -> None:
    found = []
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        assert run.carry_out(settings(method, seed), tmp_path / name) == 0
        found.append(read(tmp_path / name))
    record = found[0]
    own = record.centers[record.method == method]
    assert len(own)
    assert np.isfinite(own).all()
    assert (own >= record.lower - 1e-12).all()
    assert (own <= record.upper + 1e-12).all()
    np.testing.assert_array_equal(record.centers, found[1].centers)
    if method not in ("ols", "given"):  # which draw nothing
        assert not np.array_equal(record.centers, found[2].centers)


@pytest.mark.parametrize("method", [name for name in METHODS if name not in HEURISTICS])
def test_every_search_survives_scores_that_are_nan_and_goes_on_from_its_state(method: str) -> None:
    def started() -> Any:
        made = run.Run(settings(method))
        problem = made.problem()
        stage = made.stages[0]
        stage.start(problem)
        return stage

    plain, resumed = started(), started()
    for _ in range(2):
        plain.step()
    resumed.load_state_dict(plain.state_dict())
    plain.step()
    resumed.step()
    for a, b in zip(plain.rows(), resumed.rows(), strict=True):
        torch.testing.assert_close(a.centers, b.centers, rtol=0.0, atol=0.0)
    made = run.Run(settings(method))
    evaluate = made.full_evaluator

    def failing(setups: torch.Tensor) -> Any:
        setups = setups.clone()
        setups[..., :1, :, :] = torch.nan
        return Evaluator.__call__(evaluate, setups)

    if method != "gradient":  # which asks for gradients instead
        stage = made.stages[0]
        stage.start(dataclasses.replace(made.problem(), evaluate=failing))
        for _ in range(stage.steps):
            stage.step()
        for rows in stage.rows():
            assert bool(torch.isfinite(rows.centers).all())
        assert evaluate.failed_evaluations > 0


@pytest.mark.parametrize("method", METHODS)
def test_every_method_interrupted_keeps_what_it_found_and_goes_on_to_the_same_end(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run.carry_out(settings(method), tmp_path / "whole") == 0
    whole = read(tmp_path / "whole")
    write_lines, interrupted = Journal.record, tmp_path / "interrupted"

    def record_and_interrupt(journal: Journal, lines: Any) -> None:
        write_lines(journal, lines)
        signal.raise_signal(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "record", record_and_interrupt)
        assert run.carry_out(settings(method), interrupted) == 143
    partial = read(interrupted)
    assert partial.summary["stop_reason"] == "interrupted by SIGTERM"
    assert np.isfinite(partial.centers).all()
    assert (partial.method == method).any()
    assert run.carry_out(settings(method), interrupted, resume=True) == 0
    record = read(interrupted)
    assert record.summary["stop_reason"] == "budget"
    np.testing.assert_array_equal(record.centers, whole.centers)
    np.testing.assert_array_equal(record.regularity, whole.regularity)
    assert record.summary["evaluations"] == whole.summary["evaluations"]


SMALLEST: dict[str, dict[str, Any]] = {  # the least of each: one setup, start, candidate or preference where it can
    "blend": {"climbs": 1, "per_axis": 2},
    "cmaes": {"parents": 1, "population": 2, "generations": 1},
    "gradient": {"starts": 1, "population": 16, "generations": 5, "polish": 1, "front": 2, "coarse": 100},
    "given": {"centers": str(GIVEN / "one.csv")},
    "lloyd": {"starts": 1, "iterations": 1},
    "nsga2": {"population": 4, "generations": 1},
    "ols": {"per_axis": 2},
    "random": {"population": 1},
}


@pytest.mark.parametrize("method", METHODS)
def test_every_method_takes_the_smallest_budget_and_a_single_center(method: str, tmp_path: Path) -> None:
    preferences = (0.5,) if method in ("blend", "cmaes", "gradient") else None
    node = {**option("method", method), **SMALLEST[method]}
    small = settings(method, centers=1, method=node, preferences=preferences)
    assert run.carry_out(small, tmp_path) == 0
    record = read(tmp_path)
    own = record.method == method
    assert own.any()
    assert record.centers.shape[1:] == (1, 2)
    np.testing.assert_array_equal(record.regularity[own], 1.0)  # of one column
    vertices, weights = record.vertices, record.weights[:, None]
    for center, potential in zip(record.centers[own], record.improvement_potential[own], strict=True):
        column = build(option("kernel", "wendland"), 2, 0.5, 2.0)(np.linalg.norm(vertices - center, axis=1))
        column = np.sqrt(weights) * column[:, None]
        wanted = np.sqrt(weights) * record.gradient
        reached = column @ np.linalg.lstsq(column, wanted, rcond=None)[0]
        assert potential == pytest.approx(1 - np.square(wanted - reached).sum(), abs=1e-9)


def test_asking_again_before_tell_returns_the_same_of_every_search() -> None:
    lower, upper = torch.zeros(6, dtype=torch.float64), torch.ones(6, dtype=torch.float64)
    stream = torch.Generator().manual_seed(0)
    start = torch.rand(8, 6, generator=stream, dtype=torch.float64)
    nsga2 = NSGA2(start, lower, upper, generator=stream)
    cmaes = CMAES(start[:1], 0.1, lower, upper, generators=[stream], parents=4, offspring=8)
    nsga2.tell(torch.rand(len(nsga2.ask()), 2, generator=stream, dtype=torch.float64))
    for search, scores in ((nsga2, (8, 2)), (cmaes, (1, 8))):
        first = search.ask().clone()
        torch.testing.assert_close(search.ask(), first, rtol=0.0, atol=0.0)
        search.tell(torch.rand(*scores, generator=stream, dtype=torch.float64))
        assert not torch.equal(search.ask(), first)


@pytest.fixture(params=["wendland", "triharmonic"])
def kernel(request: pytest.FixtureRequest) -> Kernel:
    return build(option("kernel", request.param), 2, 0.5, 2.0)


def test_every_kernel_is_one_formula_for_numpy_and_torch(kernel: Kernel) -> None:
    r = np.array([0.0, 1e-9, 0.1, 0.49, 0.5, 0.51, 3.0])
    for formula in (kernel.phi, kernel.slope):
        ours, theirs = formula(r), formula(torch.from_numpy(r))
        assert isinstance(ours, np.ndarray)
        np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-15, atol=0)
    h = 1e-6
    inner = r[2:4]
    np.testing.assert_allclose(
        (kernel(inner + h) - kernel(inner - h)) / (2 * h), kernel.slope(inner) * inner, rtol=1e-7
    )
    again = kernel_of(kernel.spec())
    assert type(again) is type(kernel)
    np.testing.assert_array_equal(again(r), kernel(r))


@pytest.mark.parametrize("manipulation", ["indirect", "direct"])
def test_every_representation_is_one_formula_and_has_its_gradients(kernel: Kernel, manipulation: str) -> None:
    scenario = plane((9, 18))
    representation: Representation = build(option("representation", "rbf"), scenario, kernel, 4)
    space = representation.space(scenario, 4)
    setups = space.place(space.sample(3, torch.Generator().manual_seed(1)))
    assert bool(((setups >= space.lower) & (setups <= space.upper)).all())
    phi = representation.phi(scenario.vertices, setups)
    assert phi.shape == (3, len(scenario.vertices), representation.columns(setups))
    read_back = representation_of(representation.spec())
    for setup, one in zip(setups, phi, strict=True):
        found = read_back.phi(scenario.vertices.numpy(), setup.numpy())
        np.testing.assert_allclose(found, one.numpy(), rtol=1e-12, atol=1e-14)
    factor = torch.linalg.cholesky(phi.mT @ phi)
    reduced = representation.reduce(setups, factor, manipulation)
    assert not bool(reduced.singular.any())
    for setup, one, small in zip(setups, phi, reduced.factor, strict=True):
        U = representation.matrix(one, setup, manipulation)
        assert U is not None
        torch.testing.assert_close(torch.linalg.svdvals(small), torch.linalg.svdvals(U), rtol=1e-6, atol=1e-9)
    weights = torch.randn(phi.mT.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    leaf = setups.clone().requires_grad_()
    (by_autograd,) = torch.autograd.grad((representation.phi(scenario.vertices, leaf).mT * weights).sum(), leaf)
    closed = representation.pull(scenario.vertices, setups, weights)
    assert closed is not None
    torch.testing.assert_close(closed, by_autograd, rtol=1e-9, atol=1e-12)
    identity = torch.eye(4, dtype=torch.float64).expand(3, 4, 4)
    through = representation.pull_reduction(setups, Pull(identity, identity))
    assert through is not None
    assert through.shape == setups.shape
