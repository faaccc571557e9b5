"""Rules to step by, against plain NumPy and SciPy on the whole linear map of a setup; and the predicted change."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize
from test_columns import MIRRORS, field
from test_export import a_run

from rbfevo import export
from rbfevo.errors import UserError
from rbfevo.geometry import sobolev
from rbfevo.recorded.moves import RULES, Move, predicted_change, wanted_move
from rbfevo.recorded.record import Record, read
from rbfevo.recorded.setup import setup
from rbfevo.scoring.maxnorm import Block, best_displacement, norm

CASES = [(symmetry, manipulation) for symmetry in MIRRORS[:2] for manipulation in ("indirect", "direct")]
SENSITIVITY = {"gradient_is": "direction", "objective": "minimize"}


def a_record(tmp_path: Path, symmetry: Any = None, **summary: Any) -> Record:
    on = 0 if symmetry is None else 2
    return read(a_run(tmp_path / "run", symmetry=symmetry, on=on, **{**SENSITIVITY, **summary}))


def linear_maps(record: Record, row: int) -> tuple[np.ndarray, np.ndarray]:
    """A [n k, m k] from weights to displacements of the vertices, and those of the centers [m k, m k]."""
    m, k = len(record.centers[row]), record.gradient.shape[1]
    units = [unit.reshape(m, k) for unit in np.eye(m * k)]
    return tuple(
        np.stack([field(record, row, points, unit).ravel() for unit in units], axis=1)
        for points in (record.vertices, record.centers[row])
    )  # pyright: ignore[reportReturnType]


def check_alike(found: np.ndarray, expected: np.ndarray, tolerance: float = 1e-7) -> None:
    """Check that two displacements have one direction."""
    a, b = found.ravel() / np.linalg.norm(found), expected.ravel() / np.linalg.norm(expected)
    np.testing.assert_allclose(a, b, atol=tolerance)


def rising(record: Record) -> np.ndarray:
    """-s of every vertex and component, up to a factor."""
    return (record.weights[:, None] * record.gradient).ravel()


@pytest.mark.parametrize(("symmetry", "manipulation"), CASES)
def test_steepest_descent_is_the_gradient_in_the_parameters(symmetry: Any, manipulation: str, tmp_path: Path) -> None:
    record = a_record(tmp_path, symmetry, manipulation=manipulation)
    move = wanted_move(record, setup(record, 0), 0.1, "steepest")
    A, centers = linear_maps(record, 0)
    if manipulation == "direct":
        A = A @ np.linalg.pinv(centers, rcond=1e-13)
    check_alike(move.reached, A @ (A.T @ rising(record)))


@pytest.mark.parametrize("length", [None, 0.3])
@pytest.mark.parametrize(("symmetry", "manipulation"), CASES)
def test_natural_is_the_projection_in_the_metric_of_the_filter(
    symmetry: Any, manipulation: str, length: float | None, tmp_path: Path
) -> None:
    record = a_record(tmp_path, symmetry, manipulation=manipulation, smooth=length)
    move = wanted_move(record, setup(record, 0), 0.1, "natural")
    A, _ = linear_maps(record, 0)
    X, faces = record.vertices, record.faces
    metric = np.diag(sobolev.mass(X, faces)) + (length or 0.0) ** 2 * sobolev.stiffness(X, faces).toarray()
    metric = np.kron(metric, np.eye(3))
    check_alike(move.reached, A @ np.linalg.lstsq(A.T @ metric @ A, A.T @ rising(record), rcond=1e-13)[0], 1e-6)


@pytest.mark.parametrize(("symmetry", "manipulation"), CASES)
def test_max_norm_gains_most_for_its_16_norm(symmetry: Any, manipulation: str, tmp_path: Path) -> None:
    record = a_record(tmp_path, symmetry, manipulation=manipulation)
    chosen = setup(record, 0)
    move = wanted_move(record, chosen, 0.1, "max-norm")
    A, _ = linear_maps(record, 0)
    left, sigma, _ = np.linalg.svd(A, full_matrices=False)
    basis = left[:, sigma > 1e-10 * sigma[0]]
    area, a = sobolev.mass(record.vertices, record.faces), rising(record)

    def loss(z: np.ndarray) -> float:
        return -float(a @ (basis @ z)) / norm((basis @ z).reshape(-1, 3), area, 16.0)

    best = min((minimize(loss, start, method="BFGS", options={"gtol": 1e-9, "maxiter": 4000})
                for start in (basis.T @ a, basis.T @ move.reached.ravel())), key=lambda found: found.fun)  # fmt: skip
    gain = float(a @ move.reached.ravel()) / norm(move.reached, area, 16.0)
    assert gain == pytest.approx(-best.fun, rel=1e-7)
    for rule in ("natural", "steepest"):  # and more for its largest displacement, too
        other = wanted_move(record, chosen, 0.1, rule)
        assert predicted_change(record, other.reached) > 1.02 * predicted_change(record, move.reached)  # pyright: ignore[reportOperatorIssue, reportOptionalOperand]


@pytest.mark.parametrize("rule", RULES)
def test_every_rule_moves_one_vertex_by_the_step_and_none_farther(rule: str, tmp_path: Path) -> None:
    record = a_record(tmp_path)
    move = wanted_move(record, setup(record, 0), 0.07, rule)
    diagonal = np.linalg.norm(np.ptp(record.vertices, axis=0))
    assert np.linalg.norm(move.reached, axis=1).max() == pytest.approx(0.07 * diagonal, rel=1e-12)
    left = move.wanted - move.reached
    assert float((record.weights[:, None] * left * move.reached).sum()) == pytest.approx(0.0, abs=1e-12)
    assert move.direction


def test_the_predicted_change_is_the_sensitivity_times_the_displacement(tmp_path: Path) -> None:
    record = a_record(tmp_path)
    # g = -s / w and |g| = 1: s is what the solver gave.
    s = -record.weights[:, None] * record.gradient * record.summary["gradient_norm"]
    move = wanted_move(record, setup(record, 0), 0.05)
    assert move.change == pytest.approx(float((s * move.reached).sum()), rel=1e-12)
    assert move.change is not None
    assert move.change < 0
    for change, expected in (
        ({"objective": "maximize"}, -move.change),
        ({"objective": None}, None),
        ({"gradient_norm": None}, None),
    ):
        other = Record(**{**vars(record), "summary": record.summary | change})
        assert predicted_change(other, move.reached) == (None if expected is None else pytest.approx(expected))
    raw = record.gradient + 0.1
    smoothed = Record(**{**vars(record), "gradient_raw": raw})
    expected = -record.summary["gradient_norm"] * float((record.weights[:, None] * raw * move.reached).sum())
    assert predicted_change(smoothed, move.reached) == pytest.approx(expected, rel=1e-12)


def test_a_setup_that_gains_nothing_does_not_move(tmp_path: Path) -> None:
    record = a_record(tmp_path)
    away = Record(**{**vars(record), "centers": record.centers + 50.0})
    for rule in RULES:
        move = wanted_move(away, setup(away, 0), 0.05, rule)
        assert not move.reached.any()
        assert not move.weights.any()
        assert np.isfinite(move.wanted).all()


def test_steepest_needs_a_psi_that_is_not_singular(tmp_path: Path) -> None:
    record = a_record(tmp_path, manipulation="direct")
    record.centers[0, 1] = record.centers[0, 0]
    with pytest.raises(UserError, match=r"--rule steepest: .*choose --rule max-norm or natural"):
        wanted_move(record, setup(record, 0), 0.05, "steepest")
    for rule in ("max-norm", "natural"):
        assert np.linalg.norm(wanted_move(record, setup(record, 0), 0.05, rule).reached) > 0


def test_the_command_line_names_the_rule_and_the_change(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = a_run(tmp_path / "run", **SENSITIVITY)  # pyright: ignore[reportArgumentType]
    moves: dict[str, Move] = {}
    record = read(run)
    for rule in (None, *RULES):
        out = tmp_path / str(rule)
        arguments = [str(run), "--pick", "knee", "--out", str(out), *([] if rule is None else ["--rule", rule])]
        assert export.main(arguments) == 0
        moves[str(rule)] = move = wanted_move(record, setup(record, 1), 0.05, rule or "max-norm")
        printed = capsys.readouterr().out
        assert f"{rule or 'max-norm'} step: a vertex moves by at most" in printed
        assert f"predicted change of the objective: {move.change:+.4g} (to first order)" in printed
        table = np.genfromtxt(out / "weights.csv", delimiter=",", names=True)
        np.testing.assert_allclose(table["wx"], move.weights[:, 0], rtol=1e-9, atol=1e-12)
    assert moves["None"].change == moves["max-norm"].change
    assert export.main([str(run), "--pick", "knee", "--out", str(tmp_path / "x"), "--rule", "fastest"]) == 2
    assert "invalid choice: 'fastest'" in capsys.readouterr().err
    target = a_run(tmp_path / "target")
    assert export.main([str(target), "--pick", "knee", "--out", str(tmp_path / "y"), "--rule", "natural"]) == 2
    assert "which is approximated; rules are for sensitivities" in capsys.readouterr().err
    assert not (tmp_path / "y").exists()
    assert json.loads((target / "summary.json").read_text()).get("gradient_is") is None


def test_the_bounded_potential_is_printed_where_it_was_searched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = a_run(tmp_path / "run", **{**SENSITIVITY, "criterion_norm": 16.0})
    with np.load(run / "setups.npz") as archive:
        arrays: dict[str, Any] = dict(archive)
    np.savez(run / "setups.npz", **arrays, bounded_potential=np.array([0.11, 0.22, 0.33, 0.44]))
    assert export.main([str(run), "--pick", "index:2", "--out", str(tmp_path / "out")]) == 0
    assert "R = 0.3, P = 0.1000, P_16 = 0.3300" in capsys.readouterr().out


# --- the maximizer alone ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("p", [2.0, 3.0, 16.0, 64.0])
def test_the_best_displacement_fulfils_the_conditions_of_its_optimum(p: float) -> None:
    rng = np.random.default_rng(1)
    X, C = rng.random((400, 3)), rng.random((6, 3))
    u = rng.random(400) + 0.1
    r = np.linalg.norm(X[:, None] - C, axis=2)
    one, other = (np.linalg.qr(np.clip(1 - r / s, 0, None) ** 4 * (4 * r / s + 1))[0] for s in (0.7, 0.5))
    a = (u / u.sum())[:, None] * (np.sin(5 * X) + 0.3 * rng.normal(size=(400, 3)))
    blocks = [Block(np.array([0, 2]), one), Block(np.array([1]), other[:, :4])]
    found = best_displacement(blocks, a, 7.0 * u, p)
    d, u = found.displacement, u / u.sum()
    assert norm(d, u, p) == pytest.approx(1.0, rel=1e-12)
    assert found.gain == pytest.approx(float((a * d).sum()), rel=1e-12)
    np.testing.assert_allclose(d[:, [0, 2]], one @ found.coordinates[0], atol=1e-12)
    slope = a - found.gain * (u * np.linalg.norm(d, axis=1) ** (p - 2))[:, None] * d  # of a.d - gain |d|_p
    pulled = [one.T @ slope[:, [0, 2]], other[:, :4].T @ slope[:, [1]]]
    assert max(float(np.abs(part).max()) for part in pulled) < 1e-8 * found.gain
    if p == 2.0:
        roots = np.sqrt(u)[:, None]
        reached = sum(
            np.square(np.linalg.qr(roots * basis)[0].T @ (a[:, c] / roots)).sum()
            for c, basis in (([0, 2], one), ([1], other[:, :4]))
        )
        assert found.gain == pytest.approx(np.sqrt(reached), rel=1e-12)


def test_sizes_do_not_matter() -> None:
    rng = np.random.default_rng(2)
    basis, u = np.linalg.qr(rng.normal(size=(100, 4)))[0], rng.random(100) + 0.5
    a = rng.normal(size=(100, 3))
    plain = best_displacement([Block(np.arange(3), basis)], a, u)
    for size in (1e-120, 1e120):
        scaled = best_displacement([Block(np.arange(3), basis)], size * a, u)
        np.testing.assert_allclose(scaled.displacement, plain.displacement, rtol=1e-6, atol=1e-9)
        assert scaled.gain == pytest.approx(size * plain.gain, rel=1e-9)
