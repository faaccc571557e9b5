"""A small design of several objectives, and its potentials in plain NumPy from a run's own files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.distance import cdist
from test_mesh_runs import egg

from rbfevo.__main__ import main
from rbfevo.recorded.record import Record, read
from rbfevo.scenarios import mesh
from rbfevo.scenarios.scenario import Scenario

SUPPORT = 1.5
HELD = ["scenario.hold=[-1.2,null,null,0.3,null,null]", "scenario.hold_width=1.0"]
MIRRORED = ["scenario.symmetry=y", "scenario.symmetry_at=0", "scenario.weights=area"]


def eggs(directory: Path, subdivisions: int = 2) -> Path:
    """Write an egg and three symmetric sensitivities beside it: s.npy (drag), lift.npy and climb.npy."""
    template = egg(directory, subdivisions)
    read_back: Any = trimesh.load(template, process=False)
    x, zero = np.asarray(read_back.vertices), np.zeros(len(read_back.vertices))
    np.save(directory / "lift.npy", np.stack([0.3 * x[:, 0] * x[:, 2], zero, np.exp(-((x[:, 0] - 1.0) ** 2))], axis=1))
    np.save(directory / "climb.npy", np.stack([x[:, 0] ** 2, 0.5 * x[:, 1] * x[:, 0], np.cos(3 * x[:, 0])], axis=1))
    return template


def sources(template: Path, *names: str) -> list[str]:
    """The files of some sensitivities."""
    return [str(template.parent / f"{name}.npy") for name in names or ("s", "lift")]


def scenario(template: Path, *names: str, **settings: Any) -> Scenario:
    """The design with some sensitivities, two unless others are named."""
    return mesh(str(template), sensitivity=sources(template, *names), **settings)


def searched(out: Path, template: Path, *overrides: str, names: tuple[str, ...] = ("s", "lift")) -> Record:
    """A run with some sensitivities, read back."""
    listed = ",".join(sources(template, *names))
    fixed = [f"scenario.template={template}", f"scenario.sensitivity=[{listed}]", "evaluator=eager", "quiet=true"]
    fixed += ["figures=false", "centers=5", f"kernel.support={SUPPORT}"]
    assert main([f"hydra.run.dir={out}", "scenario=mesh", *fixed, *overrides]) == 0
    return read(out)


def phi(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Wendland's kernel of all pairs."""
    r = cdist(a, b)
    return np.where(r < SUPPORT, (1 - r / SUPPORT) ** 4 * (4 * r / SUPPORT + 1), 0)


def blocks(record: Record, C: np.ndarray) -> list[tuple[list[int], np.ndarray]]:
    """Components of a displacement with their columns of U, of a setup [m, 3] of a run."""
    X, blend = record.vertices, 1.0 if record.blend is None else record.blend[:, None]
    if record.summary["planar"] is not None:
        return [([0, 1], blend * phi(X, C))]  # across z
    if record.summary["symmetry"] is None:
        return [([0, 1, 2], blend * phi(X, C))]
    off = C[C[:, 1] != 0]
    images, others = C * (1, -1, 1), off * (1, -1, 1)
    return [([0, 2], blend * (phi(X, C) + phi(X, images))), ([1], blend * (phi(X, off) - phi(X, others)))]


def plain_potential(record: Record, gradient: np.ndarray, C: np.ndarray) -> float:
    """P of a setup for a gradient [n, 3], or for stacked ones [n, 3 J]."""
    roots, reached = np.sqrt(record.weights)[:, None], 0.0
    for components, U in blocks(record, C):
        left, sigma, _ = np.linalg.svd(roots * U, full_matrices=False)
        left = left[:, sigma > max(U.shape) * np.finfo(float).eps * sigma[0]]
        columns = [column for column in range(gradient.shape[1]) if column % 3 in components]
        reached += float(np.square(left.T @ (roots * gradient[:, columns])).sum())
    return reached
