"""The descent on objectives with a known minimum: a quadratic in the displacement, by NumPy's least squares."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize
from test_columns import MIRRORS, field
from test_export import a_run

from rbfevo.arrays import Array
from rbfevo.descent import Descent, State, files
from rbfevo.descent.curvature import Coordinates, bounded_step, hessian
from rbfevo.descent.loop import RULES
from rbfevo.descent.sensitivity import attainable, looking_at, own
from rbfevo.errors import UserError
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import Setup, setup
from rbfevo.scenarios.smoothing import smoothed

ROW = 1


@dataclasses.dataclass
class Quadratic:
    """J = offset + sum_i w_i |a_i (d_i - t_i)|^2 / 2 of displacements d, with the minimum that a setup reaches."""

    record: Record
    chosen: Setup
    sign: float = 1.0
    offset: float = 0.0
    bend: float = 1.0  # the largest ratio of curvatures

    def __post_init__(self) -> None:
        rng = np.random.default_rng(3)
        X = self.record.vertices
        self.target = 0.1 * np.stack([np.sin(2 * X[:, 1]), X[:, 0] * X[:, 2], np.cos(X[:, 0])], axis=1)
        self.scale = self.bend ** rng.uniform(-0.5, 0.5, len(X))
        self.solutions = 0

    def map(self) -> Array:
        """[n k, m k] from weights to displacements."""
        m = len(self.chosen.centers)
        units = np.eye(3 * m).reshape(-1, m, 3)
        return np.stack([field(self.record, ROW, self.record.vertices, unit).ravel() for unit in units], axis=1)

    def __call__(self, d: Array) -> tuple[float, Array]:
        """J and dJ/dx [n, 3]."""
        self.solutions += 1
        mass = (self.record.weights * self.scale**2)[:, None]
        J = self.offset + float((mass * (d - self.target) ** 2).sum()) / 2.0
        return self.sign * J, self.sign * mass * (d - self.target)

    def minimum(self) -> float:
        root = np.repeat(np.sqrt(self.record.weights) * self.scale, 3)
        A, b = root[:, None] * self.map(), root * self.target.ravel()
        left = b - A @ np.linalg.lstsq(A, b, rcond=1e-13)[0]
        return self.offset + float(left @ left) / 2.0


def problem(path: Path, objective: str = "minimize", symmetry: Any = None, **more: Any) -> tuple[Record, Setup]:
    on = 0 if symmetry is None else 2
    summary = {"gradient_is": "direction", "objective": objective, **more}
    record = read(a_run(path / f"run-{objective}", symmetry=symmetry, on=on, **summary))
    return record, setup(record, ROW)


def begun(record: Record, chosen: Setup, rule: str, step: float = 0.02, tolerance: float = 0.0) -> Descent:
    return Descent(record, chosen, State.begin((chosen.count, 3), rule, step, tolerance))


def carried_out(descent: Descent, solve: Callable[[Array], tuple[float, Array]], most: int) -> list[float]:
    """J of all designs, at most so many."""
    found: list[float] = []
    while len(found) < most and (proposal := descent.propose() if descent.state.best else descent.state.proposal):
        J, s = solve(descent.displacement(proposal.weights))
        descent.accept(J, s)
        found.append(J)
    return found


# --- another sensitivity ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("objective", ["minimize", "maximize"])
def test_a_record_that_looks_at_its_own_sensitivity_is_itself(objective: str, tmp_path: Path) -> None:
    record, _ = problem(tmp_path, objective)
    found = looking_at(record, own(record))
    np.testing.assert_allclose(found.gradient, record.gradient, atol=1e-15)
    assert found.summary["gradient_norm"] == pytest.approx(record.summary["gradient_norm"], rel=1e-14)
    # by the definition: the wanted displacement is downhill of an objective to be minimized
    sign = -1.0 if objective == "minimize" else 1.0
    expected = sign * record.summary["gradient_norm"] * record.weights[:, None] * record.gradient
    np.testing.assert_allclose(own(record), expected, atol=1e-15)


def test_smoothing_and_vertices_that_stay_are_those_of_the_run(tmp_path: Path) -> None:
    record, _ = problem(tmp_path, smooth=0.4)
    stays = record.vertices[:, 0] > 0.6
    record = dataclasses.replace(record, stays=stays)
    s = np.random.default_rng(0).normal(size=(len(record.vertices), 3))
    raw = -s / record.weights[:, None]
    raw[stays] = 0.0
    surface = record.vertices, record.faces, record.weights
    expected = smoothed(raw, *surface, stays, 0.4, True).wanted
    size = math.sqrt((record.weights[:, None] * expected**2).sum())
    found = looking_at(record, s)
    np.testing.assert_allclose(found.gradient, expected / size, atol=1e-14)
    assert found.gradient_raw is not None
    np.testing.assert_allclose(found.gradient_raw, raw / size, atol=1e-14)
    assert found.summary["gradient_norm"] == pytest.approx(size, rel=1e-13)
    assert not found.gradient[stays].any()


@pytest.mark.parametrize("symmetry", MIRRORS[:2])
def test_the_attainable_gain_is_the_root_of_the_potential(symmetry: Any, tmp_path: Path) -> None:
    """By the projection on the whole linear map."""
    record, chosen = problem(tmp_path, symmetry=symmetry)
    root = np.sqrt(np.repeat(record.weights, 3))
    A, g = root[:, None] * Quadratic(record, chosen).map(), root * record.gradient.ravel()
    left = g - A @ np.linalg.lstsq(A, g, rcond=1e-13)[0]
    assert attainable(record, chosen) == pytest.approx(math.sqrt(1.0 - left @ left), abs=1e-12)


def test_runs_without_a_sensitivity_or_with_several_are_refused(tmp_path: Path) -> None:
    record, chosen = problem(tmp_path)
    target = dataclasses.replace(record, summary=record.summary | {"gradient_is": "displacement"})
    with pytest.raises(UserError, match="no sensitivity"):
        begun(target, chosen, "natural")
    with pytest.raises(UserError, match="choose one of max-norm"):
        begun(record, chosen, "newton")
    with pytest.raises(UserError, match="three finite components"):
        looking_at(record, np.zeros((3, 3)))


# --- the minimum -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("objective", ["minimize", "maximize"])
@pytest.mark.parametrize("rule", RULES)
def test_every_rule_goes_downhill_and_none_below_the_minimum(rule: str, objective: str, tmp_path: Path) -> None:
    record, chosen = problem(tmp_path, objective)
    sign = 1.0 if objective == "minimize" else -1.0
    quadratic = Quadratic(record, chosen, sign, bend=3.0)
    descent = begun(record, chosen, rule)
    found = sign * np.array(carried_out(descent, quadratic, 40))
    best = descent.state.best
    assert best is not None
    assert best.objective is not None
    assert sign * best.objective == found.min()
    least = quadratic.minimum()
    assert least * (1.0 - 1e-12) < found.min() < least + 0.25 * (found[0] - least)
    kept = [sign * line.objective for line in descent.state.lines if line.kept and line.objective is not None]
    assert (np.diff(kept) < 0).all()
    J, _ = quadratic(descent.displacement(best.weights))
    assert best.objective == J  # the weights are those of the design


@pytest.mark.parametrize("symmetry", MIRRORS[:2])
def test_quasi_newton_finds_the_minimum(symmetry: Any, tmp_path: Path) -> None:
    record, chosen = problem(tmp_path, symmetry=symmetry)
    quadratic = Quadratic(record, chosen, bend=3.0)
    descent = begun(record, chosen, "quasi-newton", 0.05)
    found = carried_out(descent, quadratic, 60)
    assert min(found) - quadratic.minimum() < 1e-6 * (found[0] - quadratic.minimum())
    others = {}
    for rule in ("max-norm", "natural", "steepest"):
        others[rule] = min(carried_out(begun(record, chosen, rule, 0.05), quadratic, 60))
    assert min(found) < min(others.values())


def test_the_first_step_is_as_long_as_asked_and_predicts_its_change(tmp_path: Path) -> None:
    record, chosen = problem(tmp_path)
    quadratic = Quadratic(record, chosen)
    for rule in RULES:
        descent = begun(record, chosen, rule, 1e-4)
        J, s = quadratic(descent.displacement(np.zeros((chosen.count, 3))))
        descent.accept(J, s)
        proposal = descent.propose()
        assert proposal is not None
        assert proposal.predicted is not None
        moved = descent.displacement(proposal.weights)
        diagonal = np.linalg.norm(np.ptp(record.vertices, axis=0))
        assert np.linalg.norm(moved, axis=1).max() == pytest.approx(1e-4 * diagonal, rel=1e-9)
        assert proposal.moved == pytest.approx(1e-4 * diagonal, rel=1e-9)
        assert proposal.predicted == pytest.approx(float((s * moved).sum()), rel=1e-9)
        assert quadratic(moved)[0] - J == pytest.approx(proposal.predicted, rel=1e-2)


def test_smoothing_does_not_change_what_is_predicted(tmp_path: Path) -> None:
    """The direction is that of the smoothed sensitivity, the change that of the one as it is."""
    record, chosen = problem(tmp_path, smooth=0.5)
    for rule in RULES:
        descent, quadratic = begun(record, chosen, rule, 1e-3), Quadratic(record, chosen)
        J, s = quadratic(0.0 * record.vertices)
        descent.accept(J, s)
        proposal = descent.propose()
        assert proposal is not None
        assert proposal.predicted == pytest.approx(float((s * descent.displacement(proposal.weights)).sum()), rel=1e-9)


# --- back off --------------------------------------------------------------------------------------------------------


def test_a_rise_goes_back_to_the_best_design_with_half_the_step(tmp_path: Path) -> None:
    record, chosen = problem(tmp_path)
    descent, quadratic = begun(record, chosen, "natural"), Quadratic(record, chosen)
    descent.accept(*quadratic(0.0 * record.vertices))
    first = descent.propose()
    assert first is not None
    line = descent.accept(1e9, np.ones((len(record.vertices), 3)))
    assert (line.kept, line.best, line.number) == (False, quadratic(0.0 * record.vertices)[0], 1)
    second = descent.propose()
    assert second is not None
    assert (second.number, second.size) == (2, 0.01)
    np.testing.assert_allclose(second.weights, first.weights / 2.0, rtol=1e-12)
    descent.accept(*quadratic(descent.displacement(second.weights)))
    third = descent.propose()
    assert third is not None
    assert third.size == 0.01
    assert descent.fail("the solver failed").note == "the solver failed"
    fourth = descent.propose()
    assert fourth is not None
    np.testing.assert_allclose(fourth.weights - second.weights, (third.weights - second.weights) / 2.0, atol=1e-15)
    assert [(line.number, line.kept) for line in descent.state.lines] == [(0, True), (1, False), (2, True), (3, False)]
    assert descent.accept(math.nan, np.full((len(record.vertices), 3), math.nan)).note == "J is not finite"
    assert descent.propose() is not None


def test_a_mesh_that_cannot_follow_costs_no_solution(tmp_path: Path) -> None:
    record, chosen = problem(tmp_path)
    descent, quadratic = begun(record, chosen, "max-norm"), Quadratic(record, chosen)
    descent.accept(*quadratic(0.0 * record.vertices))

    def usable(weights: Array) -> str:
        far = np.linalg.norm(descent.displacement(weights), axis=1).max()
        return "cells turn inside out" if far > 0.006 * descent.diagonal else ""

    proposal = descent.propose(usable)
    assert proposal is not None
    assert (proposal.number, proposal.size) == (1, 0.005)
    assert proposal.notes == ("step 0.02: cells turn inside out", "step 0.01: cells turn inside out")
    assert descent.accept(*quadratic(descent.displacement(proposal.weights))).note.count("inside out") == 2
    assert descent.propose(lambda _: "no") is None
    assert "halved 6 times" in descent.state.ended
    assert "no" in descent.state.ended
    assert descent.propose() is None


def test_it_ends_where_nothing_is_gained(tmp_path: Path) -> None:
    record, chosen = problem(tmp_path)
    quadratic = Quadratic(record, chosen, offset=10.0)
    descent = begun(record, chosen, "max-norm", 0.02, tolerance=1.0)
    descent.accept(*quadratic(0.0 * record.vertices))
    assert descent.propose() is None
    assert "is below 1 of the objective" in descent.state.ended
    descent = begun(record, chosen, "max-norm")
    descent.accept(1.0, np.zeros((len(record.vertices), 3)))
    assert descent.propose() is None
    assert descent.state.ended == "no step of this setup gains anything"


def test_what_is_out_of_turn_is_refused(tmp_path: Path) -> None:
    record, chosen = problem(tmp_path)
    descent = begun(record, chosen, "max-norm")
    with pytest.raises(UserError, match="cannot go back behind it"):
        descent.fail("no")
    quadratic = Quadratic(record, chosen)
    J, s = quadratic(0.0 * record.vertices)
    descent.accept(None, s)
    with pytest.raises(UserError, match="no design waits"):
        descent.accept(J, s)
    descent.propose()
    with pytest.raises(UserError, match="the objective of a design is needed"):
        descent.accept(None, s)
    assert descent.accept(J + 1.0, s).kept  # the first J is not known, so nothing rose


# --- bounds ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", RULES)
def test_accumulated_displacements_keep_to_the_bounds_and_use_them(rule: str, tmp_path: Path) -> None:
    record, chosen = problem(tmp_path)
    most = np.where(record.vertices[:, 2] > 0, 0.02, 0.05)
    bounded = dataclasses.replace(record, max_displacement=most)
    quadratic = Quadratic(record, chosen)
    descent, lengths = begun(bounded, chosen, rule), []

    def solve(d: Array) -> tuple[float, Array]:
        lengths.append((np.linalg.norm(d, axis=1) / most).max())
        return quadratic(d)

    found = carried_out(descent, solve, 40)
    assert max(lengths) <= 1.0
    assert max(lengths) > 0.999
    free = min(carried_out(begun(record, chosen, rule), quadratic, 25))
    A, m = quadratic.map(), chosen.count

    def value(p: Array) -> tuple[float, Array]:
        J, slope = quadratic((A @ p).reshape(-1, 3))
        return J, A.T @ slope.ravel()

    def room(p: Array) -> Array:
        return 1.0 - ((A @ p).reshape(-1, 3) ** 2).sum(axis=1) / most**2

    def room_slope(p: Array) -> Array:
        d = (A @ p).reshape(-1, 3)
        return -2.0 * np.einsum("nc,ncp->np", d, A.reshape(-1, 3, 3 * m)) / most[:, None] ** 2

    constraint = {"type": "ineq", "fun": room, "jac": room_slope}
    options = {"maxiter": 500, "ftol": 1e-10}
    optimum = minimize(value, np.zeros(3 * m), jac=True, method="SLSQP", constraints=constraint, options=options)
    assert optimum.success
    assert room(optimum.x).min() > -1e-8
    assert free < optimum.fun - 1e-6 <= min(found)
    share = (found[0] - min(found)) / (found[0] - optimum.fun)
    assert share > 0.97, share
    assert descent.state.ended == "no step of this setup gains anything within largest displacements"


# --- the state -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rule", ["max-norm", "quasi-newton"])
def test_a_descent_that_goes_on_from_its_files_is_the_same_to_the_bit(rule: str, tmp_path: Path) -> None:
    record, chosen = problem(tmp_path)
    quadratic = Quadratic(record, chosen, bend=2.0)
    whole = begun(record, chosen, rule, 0.05)
    expected = carried_out(whole, quadratic, 12)
    state, where = begun(record, chosen, rule, 0.05).state, tmp_path / "state"
    where.mkdir()
    found = []
    for _ in range(12):
        files.write(where, state, {"run": "x"})
        loaded = files.read(where)
        assert loaded is not None
        assert loaded[1]["run"] == "x"
        descent = Descent(record, chosen, loaded[0])
        proposal = descent.propose() if descent.state.best else descent.state.proposal
        if proposal is None:
            break
        files.write(where, descent.state, {"run": "x"})
        loaded = files.read(where)
        assert loaded is not None
        descent = Descent(record, chosen, loaded[0])
        J, s = quadratic(descent.displacement(proposal.weights))
        descent.accept(J, s)
        found.append(J)
        state = descent.state
    assert found == expected
    assert whole.state.best is not None
    assert state.best is not None
    assert np.array_equal(whole.state.best.weights, state.best.weights)
    assert [line._asdict() for line in state.lines] == [line._asdict() for line in whole.state.lines]
    assert len(list(where.glob("*.npz"))) == 1


@pytest.mark.parametrize(
    ("content", "line"),
    [
        ("{", "cannot be read: damaged"),
        ("[]", "no state of a descent of this version"),
        ('{"version": 0}', "no state of a descent of this version"),
        ('{"version": 1, "rule": "natural"}', "no state of a descent: KeyError"),
        ('{"version": 1, "sensitivity": "gone.npz"}', "gone.npz cannot be read"),
    ],
)
def test_damaged_states_get_one_line(content: str, line: str, tmp_path: Path) -> None:
    assert files.read(tmp_path) is None
    (tmp_path / "state.json").write_text(content)
    with pytest.raises(UserError, match=line):
        files.read(tmp_path)


# --- quasi-Newton ----------------------------------------------------------------------------------------------------


def spd(r: int, seed: int, most: float = 30.0) -> Array:
    Q = np.linalg.qr(np.random.default_rng(seed).normal(size=(r, r)))[0]
    return Q @ np.diag(np.geomspace(1.0, most, r)) @ Q.T


def test_the_approximated_hessian_is_that_of_a_quadratic_after_conjugate_steps() -> None:
    """BFGS: after r conjugate steps of a quadratic it is the Hessian itself."""
    H = spd(5, 1, 3.0)
    steps = np.linalg.inv(np.linalg.cholesky(H)).T  # H-conjugate
    points = np.cumsum(np.vstack([np.zeros(5), steps.T]), axis=0)
    found = hessian(list(points), [H @ x for x in points])
    assert found is not None
    np.testing.assert_allclose(found, H, atol=1e-10)


def test_it_is_positive_definite_where_slopes_are_not_convex() -> None:
    rng = np.random.default_rng(2)
    points = list(np.cumsum(rng.normal(size=(9, 4)), axis=0))
    found = hessian(points, [np.sin(3 * x) for x in points])
    assert found is not None
    assert np.linalg.eigvalsh(found).min() > 0
    assert hessian(points, [-x for x in points]) is None  # concave everywhere
    assert hessian(points[:1], points[:1]) is None


@pytest.mark.parametrize("bound", [1e3, 0.5, 0.01])
def test_a_bounded_step_is_the_best_one_within_the_bound(bound: float) -> None:
    """Of the Euclidean length it is the trust-region step, by SciPy's SLSQP."""
    B, slope = spd(4, 3), np.array([1.0, -2.0, 0.5, 3.0])
    found = bounded_step(B, slope, lambda z: float(np.linalg.norm(z)), bound)
    constraint = {"type": "ineq", "fun": lambda z: bound**2 - z @ z}
    start = -slope * min(bound, 1.0) / 10

    def model(z: Array) -> float:
        return float(slope @ z + z @ B @ z / 2)

    best = minimize(model, start, method="SLSQP", constraints=constraint, tol=1e-14)
    assert np.linalg.norm(found) <= bound * (1 + 1e-12)
    assert model(found) == pytest.approx(best.fun, rel=1e-6)
    if bound > 10:
        np.testing.assert_allclose(found, -np.linalg.solve(B, slope), rtol=1e-12)


@pytest.mark.parametrize("symmetry", MIRRORS[:2])
def test_coordinates_measure_the_displacement_over_the_surface(symmetry: Any, tmp_path: Path) -> None:
    from rbfevo.geometry import sobolev

    record, chosen = problem(tmp_path, symmetry=symmetry, smooth=0.3)
    coordinates, rng = Coordinates(record, chosen), np.random.default_rng(4)
    weights = rng.normal(size=(chosen.count, 3))
    weights[chosen.on_plane, 1] = 0.0
    z, d = coordinates.of(weights), chosen.displacement(record.vertices, weights)
    M, K = sobolev.mass(record.vertices, record.faces), sobolev.stiffness(record.vertices, record.faces)
    assert z @ z == pytest.approx(float((M[:, None] * d**2).sum() + 0.09 * (d * (K @ d)).sum()), rel=1e-10)
    np.testing.assert_allclose(coordinates.weights(z), weights, atol=1e-8)
    s = rng.normal(size=d.shape)
    slope = coordinates.slope(coordinates.slope_of(looking_at(record, s)))
    assert slope @ z == pytest.approx(float((s * d).sum()), rel=1e-9)
