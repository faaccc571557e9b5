"""`--keep`: the step under which some objectives get no worse is the best one, beside SciPy's solvers in NumPy.

A step is q = U w under f_i . q >= 0 for each objective i that is kept. Two rules maximize a . q for a quadratic length
of w, |L w| = 1: the best is H^-1 (b + F mu) with the multipliers mu >= 0 that make it shortest (the dual problem),
which is a nonnegative least-squares problem. The rule max-norm maximizes a . q / |q|_16, a convex problem for SLSQP.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import trimesh
from scipy.optimize import minimize, nnls

from rbfevo.recorded.moves import wanted_move
from rbfevo.recorded.objectives import Candidate, best_keeping
from rbfevo.recorded.record import Record
from rbfevo.recorded.setup import Setup, setup
from tests import several
from tests.test_given import HALF, table

NAMES = ("s", "lift", "climb")
SIGNS = {"s": -1.0, "lift": 1.0, "climb": 1.0}  # which way each gets better
STEP = 0.03
KEPT = [kept for size in (1, 2) for kept in itertools.combinations(NAMES, size)]


class Posed(NamedTuple):
    """A step's problem: U [n, 3, r] of the displacement by the weights, in one column for each weight.

    Attributes:
        rising: [n, 3] what is climbed; kept: [n, 3] of each objective what it gains; areas, most: [n].
    """

    U: np.ndarray
    rising: np.ndarray
    kept: list[np.ndarray]
    areas: np.ndarray
    most: np.ndarray
    parameters: np.ndarray

    def of(self, field: np.ndarray) -> np.ndarray:
        """What a field gains by each weight [r]."""
        return np.einsum("nk,nkr->r", field, self.U)


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return several.eggs(tmp_path_factory.mktemp("egg"))


@pytest.fixture(scope="module", params=["plain", "indirect", "symmetric", "bounds"])
def found(request: pytest.FixtureRequest, template: Path, tmp_path_factory: pytest.TempPathFactory) -> Record:
    """A run of one setup with three objectives, of different weights."""
    out = tmp_path_factory.mktemp(request.param)
    given = ["method=given", f"method.centers={table(out / 'five.csv', HALF, 'x,y,z')}"]
    more = {
        "plain": [],
        "indirect": ["manipulation=indirect", *several.HELD],
        "symmetric": [*several.MIRRORED, *several.HELD],
        "bounds": [f"scenario.max_displacement={bounds(template, out)}"],
    }[request.param]
    ways = [f"scenario.objective=[{','.join('minimize' if SIGNS[name] < 0 else 'maximize' for name in NAMES)}]"]
    weights = ["scenario.objective_weights=[0.3,2,1]"]
    return several.searched(out / "run", template, *given, *more, *ways, *weights, names=NAMES)


def bounds(template: Path, out: Path) -> Path:
    """Bounds that are narrow at one end of the egg."""
    x = np.load(template.parent / "lift.npy")[:, 2]
    np.save(out / "most.npy", np.where(x < 0.05, 0.004, 0.3))
    return out / "most.npy"


def posed(template: Path, record: Record, chosen: Setup, kept: tuple[str, ...], followed: str | None) -> Posed:
    """The problem from the run's files and those of the sensitivities; nothing of it is computed as moves do."""
    raw = {name: SIGNS[name] * np.load(template.parent / f"{name}.npy") for name in NAMES}
    if record.blend is not None:
        raw = {name: np.where(record.blend[:, None] > 0, field, 0.0) for name, field in raw.items()}
    shares = {"s": 0.3, "lift": 2.0, "climb": 1.0}
    nodal = {name: field / record.weights[:, None] for name, field in raw.items()}  # densities have the unit norm
    norms = {name: np.sqrt((record.weights[:, None] * field**2).sum()) for name, field in nodal.items()}
    rising = sum(shares[name] / norms[name] * raw[name] for name in NAMES) if followed is None else raw[followed]
    n, columns = len(record.vertices), []
    psi = []
    for components, U in several.blocks(record, chosen.centers):
        rows = several.phi(chosen.centers, chosen.centers)
        for component in components:
            for column in U.T:
                full = np.zeros((n, 3))
                full[:, component] = column
                columns.append(full)
        psi += [rows] * len(components)
    mesh = trimesh.Trimesh(record.vertices, record.faces, process=False)
    areas = np.zeros(n)
    np.add.at(areas, mesh.faces.ravel(), np.repeat(mesh.area_faces / 3.0, 3))
    size = STEP * float(np.linalg.norm(np.ptp(record.vertices, axis=0)))
    most = np.full(n, size) if record.max_displacement is None else np.minimum(record.max_displacement, size)
    U = np.stack(columns, axis=2)
    direct = chosen.manipulation == "direct" and record.summary["symmetry"] is None
    parameters = np.kron(np.eye(3), several.phi(chosen.centers, chosen.centers)) if direct else np.eye(U.shape[2])
    return Posed(U, np.asarray(rising), [raw[name] for name in kept], areas, most, parameters)


def quadratic(problem: Posed, metric: np.ndarray) -> np.ndarray:
    """The best displacement [n, 3], of any size, for the length w.(metric w) of weights."""
    L = np.linalg.cholesky(metric)
    b = np.linalg.solve(L, problem.of(problem.rising))
    F = np.stack([np.linalg.solve(L, problem.of(field)) for field in problem.kept], axis=1)
    scale = np.linalg.norm(F, axis=0)
    multipliers, _ = nnls(F / scale, -b)
    return problem.U @ np.linalg.solve(L.T, b + F / scale @ multipliers)


def bounded(problem: Posed) -> float:
    """The gain of the best displacement with |d/most|_16 = 1, a mean by area."""
    share = problem.U / problem.most[:, None, None]
    u = problem.areas / problem.areas.sum()
    # Orthonormal columns, so that SLSQP sees no ill-conditioned problem.
    flat = (np.sqrt(u)[:, None, None] * share).reshape(-1, share.shape[2])
    T = np.linalg.inv(np.linalg.qr(flat, mode="r"))
    a, fields = T.T @ problem.of(problem.rising), [T.T @ problem.of(field) for field in problem.kept]
    A = share @ T

    def length(z: np.ndarray) -> tuple[float, np.ndarray]:
        d = A @ z
        lengths = np.linalg.norm(d, axis=1)
        top = lengths.max()
        powers = (lengths / top) ** 14
        value = top * float(u @ (lengths / top) ** 16) ** (1 / 16)
        slope = np.einsum("n,nk,nkr->r", u * powers, d, A) / top * (value / top) ** -15
        return value, slope

    a = a / np.linalg.norm(a)
    constraints = [{"type": "eq", "fun": lambda z: a @ z - 1.0, "jac": lambda z: a}]
    for field in fields:
        row = field / np.linalg.norm(field)
        constraints.append({"type": "ineq", "fun": lambda z, row=row: row @ z, "jac": lambda z, row=row: row})
    F = np.stack([field / np.linalg.norm(field) for field in fields], axis=1)
    start = a + F @ nnls(F, -a)[0]
    best = minimize(length, start / (a @ start), jac=True, constraints=constraints, method="SLSQP",
                    options={"maxiter": 2000, "ftol": 1e-14})  # fmt: skip
    if not best.success:
        raise AssertionError(best.message)
    return float(np.linalg.norm(T.T @ problem.of(problem.rising)) / best.fun)


@pytest.mark.parametrize("kept", KEPT, ids="+".join)
@pytest.mark.parametrize("followed", [None, "s"])
def test_rules_with_a_quadratic_length_find_the_best_step(
    found: Record, template: Path, kept: tuple[str, ...], followed: str | None
) -> None:
    chosen = setup(found, 0)
    problem = posed(template, found, chosen, kept, followed)
    flat = problem.U.reshape(-1, problem.U.shape[2])
    mass = flat.T @ (np.repeat(problem.areas, 3)[:, None] * flat)
    metrics = {"natural": mass}
    if found.summary["symmetry"] is None:
        metrics["steepest"] = problem.parameters.T @ problem.parameters
    for rule, metric in metrics.items():
        best = quadratic(problem, metric)
        if float((problem.rising * best).sum()) <= 1e-9 * np.abs(problem.rising * best).sum():
            continue  # nothing gains; wanted_move refuses
        move = wanted_move(found, chosen, STEP, rule, followed, kept)
        factor = float((problem.most / np.linalg.norm(best, axis=1).clip(1e-300)).min())
        if found.max_displacement is None:
            factor = problem.most[0] / np.linalg.norm(best, axis=1).max()
        np.testing.assert_allclose(move.reached, factor * best, atol=1e-6 * problem.most.max())


@pytest.mark.parametrize("kept", KEPT, ids="+".join)
def test_max_norm_finds_the_best_step(found: Record, template: Path, kept: tuple[str, ...]) -> None:
    chosen = setup(found, 0)
    problem = posed(template, found, chosen, kept, None)
    move = wanted_move(found, chosen, STEP, "max-norm", None, kept)
    u = problem.areas / problem.areas.sum()
    lengths = np.linalg.norm(move.reached, axis=1) / problem.most
    assert lengths.max() == pytest.approx(1.0, abs=1e-9)
    gain = float((problem.rising * move.reached).sum()) / float(u @ lengths**16) ** (1 / 16)
    assert gain == pytest.approx(bounded(problem), rel=1e-5)
    for field in problem.kept:
        assert float((field * move.reached).sum()) >= -1e-9 * np.abs(field * move.reached).sum()


def test_there_is_something_to_keep(found: Record, template: Path) -> None:
    """The free steps make an objective worse, or the tests above would test nothing."""
    chosen, lost = setup(found, 0), set()
    for followed in (None, *NAMES):
        for rule in ("max-norm", "natural"):
            move = wanted_move(found, chosen, STEP, rule, followed)
            lost |= {(followed, change.name) for change in move.changes if change.gain < 0}
    assert len(lost) >= 2
    assert {name for followed, name in lost if followed is None}


def test_branch_and_bound_finds_the_projection_onto_the_cone() -> None:
    """In the plain metric the best step is the projection of what rises onto the cone of steps that lose nothing."""
    drawn = np.random.default_rng(5)
    several_lost = 0
    for _ in range(200):
        rising, fields = drawn.standard_normal((6, 1)), [drawn.standard_normal((6, 1)) for _ in range(4)]
        F = np.concatenate(fields, axis=1)

        def solve(still: Sequence[int], rising: np.ndarray = rising, F: np.ndarray = F) -> Candidate:
            lost = F[:, list(still)]
            found = rising - lost @ np.linalg.lstsq(lost, rising, rcond=None)[0]
            return Candidate(found, found, float(np.linalg.norm(found)))

        multipliers, _ = nnls(F, -rising[:, 0])
        expected = rising[:, 0] + F @ multipliers
        several_lost += int((F.T @ rising < 0).sum() > 1 and (multipliers > 0).sum() < (F.T @ rising < 0).sum())
        np.testing.assert_allclose(best_keeping(solve, fields).displacement[:, 0], expected, atol=1e-9)
    assert several_lost > 20  # where not all that lose by the free step are at their bounds in the best one
