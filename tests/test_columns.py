"""Columns of a recorded setup against plain loops, with and without a symmetry plane."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import RBFInterpolator

from rbfevo.errors import UserError
from rbfevo.figures import local_error
from rbfevo.recorded import setup
from rbfevo.recorded.record import Record
from rbfevo.scoring.kernels import Wendland, triharmonic

MIRRORS = [None, {"axis": "y", "at": 0.0}, {"axis": "x", "at": 0.3}]


def phi(r: Any, kernel: str, support: float | None, d: int) -> Any:
    """Kernel values, written out again so that they are an oracle."""
    r = np.asarray(r, dtype=np.float64)
    if kernel == "wendland":
        assert support is not None
        return np.where(r < support, (1 - r / support) ** 4 * (4 * r / support + 1), 0.0)
    return r**3 if d == 3 else np.where(r > 0, r * r * np.log(r + (r == 0)), 0.0)


def recorded(
    *,
    d: int = 3,
    k: int = 3,
    m: int = 5,
    kernel: str = "wendland",
    symmetry: Any = None,
    on: tuple[int, ...] = (),
    **more: Any,
) -> Record:
    """A run of two setups; centers `on` lie on the symmetry plane."""
    rng = np.random.default_rng(m + 10 * d)
    vertices = rng.uniform(-1, 1, (80, d))
    weights = rng.uniform(0.2, 2.0, 80)
    g = rng.normal(size=(80, k)) * (1 + vertices[:, :1])
    g /= np.sqrt((weights[:, None] * g**2).sum())
    centers = rng.uniform(-0.9, 0.9, (2, m, d))
    if symmetry is not None:
        centers[:, list(on), "xyz".index(symmetry["axis"])] = symmetry["at"]
    summary = {"kernel": kernel, "support": 1.1 if kernel == "wendland" else None, "manipulation": "direct"}
    return Record(
        centers=centers,
        regularity=np.array([0.5, 0.25]),
        improvement_potential=np.array([0.5, 0.75]),
        method=np.array(["ols", "lloyd"]),
        preference=np.full(2, np.nan),
        nondominated=np.ones(2, dtype=bool),
        vertices=vertices,
        faces=np.empty((0, 3), dtype=int),
        gradient=g,
        weights=weights,
        lower=np.full(d, -1.0),
        upper=np.full(d, 1.0),
        summary={**summary, "gradient_norm": 2.5, "symmetry": symmetry, **more},
    )


def field(record: Record, row: int, points: Any, weights: Any) -> Any:
    """Displacements [q, k] by the definition: a sum over the centers and, with a mirror, over their images."""
    kernel, support = record.summary["kernel"], record.summary["support"]
    d, k = points.shape[1], weights.shape[1]
    symmetry, total = record.summary["symmetry"], np.zeros((len(points), k))
    for center, weight in zip(record.centers[row], weights, strict=True):
        total += phi(np.linalg.norm(points - center, axis=1), kernel, support, d)[:, None] * weight
        if symmetry is not None:
            axis = "xyz".index(symmetry["axis"])
            image, mirrored = center.copy(), weight.copy()
            image[axis] = 2 * symmetry["at"] - center[axis]
            if k > 1:
                mirrored[axis] *= -1
            total += phi(np.linalg.norm(points - image, axis=1), kernel, support, d)[:, None] * mirrored
    return total


@pytest.mark.parametrize("symmetry", MIRRORS)
@pytest.mark.parametrize("kernel", ["wendland", "triharmonic"])
@pytest.mark.parametrize(("d", "k"), [(2, 1), (3, 3), (2, 3), (3, 1)])
def test_the_displacement_is_the_sum_over_centers_and_images(d: int, k: int, kernel: str, symmetry: Any) -> None:
    record = recorded(d=d, k=k, kernel=kernel, symmetry=symmetry)
    rng = np.random.default_rng(0)
    points, weights = rng.uniform(-2, 2, (50, d)), rng.normal(size=(5, k))
    chosen = setup.setup(record, 1)
    expected = field(record, 1, points, weights)
    np.testing.assert_allclose(chosen.displacement(points, weights), expected, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_allclose(chosen.displacement(points, weights, block=7), expected, atol=1e-11)
    assert (chosen.row, chosen.regularity, chosen.improvement_potential) == (1, 0.25, 0.75)


@pytest.mark.parametrize(("d", "name"), [(2, "thin_plate_spline"), (3, "cubic")])
def test_weights_are_those_of_scipys_interpolation(d: int, name: str) -> None:
    record = recorded(d=d, kernel="triharmonic")
    values = np.random.default_rng(3).normal(size=(5, 3))
    chosen, points = setup.setup(record, 0), np.random.default_rng(4).normal(size=(20, d))
    expected = RBFInterpolator(record.centers[0], values, kernel=name, degree=-1)(points)
    np.testing.assert_allclose(chosen.displacement(points, chosen.weights(values)), expected, atol=1e-9)


@pytest.mark.parametrize("on", [(), (0, 3), (0, 1, 2, 3, 4)])
@pytest.mark.parametrize("symmetry", MIRRORS)
@pytest.mark.parametrize("kernel", ["wendland", "triharmonic"])
@pytest.mark.parametrize(("d", "k"), [(2, 1), (3, 3)])
def test_weights_move_the_centers_by_what_was_asked(
    d: int, k: int, kernel: str, symmetry: Any, on: tuple[int, ...]
) -> None:
    record = recorded(d=d, k=k, kernel=kernel, symmetry=symmetry, on=on)
    asked = np.random.default_rng(2).normal(size=(5, k))
    if symmetry is not None and k > 1:
        asked[list(on), "xyz".index(symmetry["axis"])] = 0.0
    chosen = setup.setup(record, 0)
    weights = chosen.weights(asked)
    np.testing.assert_allclose(field(record, 0, record.centers[0], weights), asked, atol=1e-9)
    if symmetry is None:
        assert not chosen.on_plane.any()
        return
    assert set(np.flatnonzero(chosen.on_plane)) == set(on)
    if k > 1:
        assert (weights[list(on), "xyz".index(symmetry["axis"])] == 0).all()
    # The image of a center goes where the mirror image of the center goes.
    physical = chosen.centers_and_images()
    moved = chosen.with_images(asked)
    np.testing.assert_allclose(field(record, 0, physical.points, weights), moved, atol=1e-9)
    assert len(physical.points) == 10 - len(on)
    assert physical.column[physical.mirrored].tolist() == [j for j in range(5) if j not in on]


@pytest.mark.parametrize("on", [(), (1, 2)])
@pytest.mark.parametrize("symmetry", MIRRORS)
@pytest.mark.parametrize(("d", "k"), [(2, 1), (3, 3)])
def test_psi_and_columns_by_parity(d: int, k: int, symmetry: Any, on: tuple[int, ...]) -> None:
    record = recorded(d=d, k=k, symmetry=symmetry, on=on)
    chosen, C = setup.setup(record, 0), record.centers[0]
    for across, sign in ((False, 1.0), (True, -1.0)):
        off = [j for j in range(5) if not (across and symmetry is not None and j in on)]
        plain = phi(np.linalg.norm(C[:, None] - C[None], axis=2), "wendland", 1.1, d)
        if symmetry is not None:
            images = C.copy()
            images[:, "xyz".index(symmetry["axis"])] *= -1
            images[:, "xyz".index(symmetry["axis"])] += 2 * symmetry["at"]
            plain = plain + sign * phi(np.linalg.norm(C[:, None] - images[None], axis=2), "wendland", 1.1, d)
            assert np.abs(chosen.columns(record.vertices, True)[:, list(on)]).max(initial=0.0) == 0.0
        np.testing.assert_allclose(chosen.psi(across), plain[np.ix_(off, off)], atol=1e-14)


@pytest.mark.parametrize("symmetry", MIRRORS)
@pytest.mark.parametrize("kernel", ["wendland", "triharmonic"])
@pytest.mark.parametrize(("d", "k"), [(2, 1), (3, 3)])
def test_the_best_approximation_is_the_pseudoinverses(d: int, k: int, kernel: str, symmetry: Any) -> None:
    record = recorded(d=d, k=k, kernel=kernel, symmetry=symmetry, on=(2,))
    # The whole linear map from weights to displacements, column by column, through the oracle above.
    units = np.eye(5 * k).reshape(-1, 5, k)
    A = np.stack([field(record, 0, record.vertices, unit).ravel() for unit in units], axis=1)
    root = np.sqrt(np.repeat(record.weights, k))
    solution = np.linalg.pinv(root[:, None] * A, rcond=1e-13) @ (root * record.gradient.ravel())
    chosen = setup.setup(record, 0)
    np.testing.assert_allclose(chosen.best(record), 2.5 * solution.reshape(5, k), atol=1e-8)
    np.testing.assert_allclose(chosen.fit(record, block=7), solution.reshape(5, k), atol=1e-8)
    expected = (A @ solution).reshape(-1, k)
    np.testing.assert_allclose(local_error.reached(record, 0), expected, atol=1e-10)


def test_a_duplicate_center_gets_the_least_weights_and_cannot_be_moved_alone() -> None:
    record = recorded()
    record.centers[0, 1] = record.centers[0, 0]
    chosen = setup.setup(record, 0)
    best = chosen.best(record)
    np.testing.assert_allclose(best[0], best[1], atol=1e-12)
    assert chosen.singular()
    with pytest.raises(UserError, match="numerically singular"):
        chosen.weights(np.ones((5, 3)))
    single = dataclasses.replace(
        record, centers=record.centers[:, :1], summary={**record.summary, "kernel": "triharmonic"}
    )
    assert setup.setup(single, 0).singular()  # Psi = 0


def test_a_center_stays_on_its_plane() -> None:
    chosen = setup.setup(recorded(symmetry=MIRRORS[2], on=(3,)), 0)
    with pytest.raises(UserError, match=r"center 3 lies on the symmetry plane x = 0\.3 .* along x must be 0, not 2"):
        chosen.weights(np.full((5, 3), 2.0))


@pytest.mark.parametrize(
    ("summary", "message"),
    [
        ({"kernel": "gauss"}, "kernel=gauss"),
        ({"support": None}, "support radius None"),
        ({"support": float("inf")}, "support radius inf"),
        ({"symmetry": {"axis": "w", "at": 0.0}}, "must have an axis"),
        ({"symmetry": {"axis": "x"}}, "must have an axis"),
        ({"symmetry": "y"}, "must have an axis"),
        ({"symmetry": {"axis": ["x"], "at": 0.0}}, "must have an axis"),
        ({"symmetry": {"axis": "x", "at": float("nan")}}, "must have an axis"),
    ],
)
def test_an_unknown_kernel_or_symmetry_is_one_line(summary: dict[str, Any], message: str) -> None:
    record = recorded()
    with pytest.raises(UserError, match=message):
        setup.setup(dataclasses.replace(record, summary={**record.summary, **summary}), 0)


@given(st.floats(0, 3), st.floats(0.01, 3))
def test_kernels_are_the_written_out_ones(r: float, support: float) -> None:
    assert float(Wendland(support)(np.array(r))) == pytest.approx(
        float(phi(r, "wendland", support, 3)), rel=1e-15, abs=1e-15
    )
    for d in (2, 3):
        assert float(triharmonic(d)(np.array(r))) == pytest.approx(
            float(phi(r, "triharmonic", None, d)), rel=1e-15, abs=1e-15
        )


def test_many_points_need_little_memory() -> None:
    """In a process of its own: its peak of memory, with 200,000 points and 400 centers, is far below Phi's 640 MB."""
    program = """
import resource, numpy as np
from rbfevo.recorded.setup import Mirror, Setup
from rbfevo.scoring.kernels import Cubic
from rbfevo.scoring.representations import RBF
rng = np.random.default_rng(0)
centers, points = rng.uniform(size=(400, 3)), rng.uniform(size=(200_000, 3))
chosen = Setup(centers, RBF(Cubic()), "indirect", Mirror(0, 0.0), np.zeros(400, bool), 0, 0.0, 0.0)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
moved = chosen.displacement(points, np.ones((400, 3)))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, moved.shape)
"""
    reply = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    kilobytes, *shape = reply.split()
    assert shape == ["(200000,", "3)"]
    assert int(kilobytes) < 250_000


@pytest.mark.parametrize("module", ["recorded.setup", "export", "apply", "commands.center_rows", "files"])
def test_torch_is_not_imported(module: str) -> None:
    program = f"import sys, rbfevo.{module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
