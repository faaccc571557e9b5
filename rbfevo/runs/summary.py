"""What summary.json holds of a run."""

from __future__ import annotations

import functools
import importlib.metadata
import math
import platform
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch

from rbfevo.methods.method import Rows
from rbfevo.scenarios.objectives import Objectives

if TYPE_CHECKING:
    from rbfevo.runs.assembly import Parts
    from rbfevo.runs.run import Run


def summary(run: Run, volume: float) -> dict[str, Any]:
    """The contents of `summary.json`."""
    evaluations = run.total("evaluations")
    return {
        **of_parts(run),
        "method": run.name,
        "seed": run.settings.seed,
        "device": describe(run.device),
        "versions": versions(),
        "evaluations": evaluations,
        "failed_evaluations": run.total("failed_evaluations"),
        "further_passes": run.total("further_passes"),
        "factorizations": run.total("factorizations"),
        "gradients": run.total("gradients"),
        "coarse_vertices": [len(evaluator.deformation.vertices) for evaluator in run.coarse_evaluators],
        "scored_by": "definition" if run.defined else "evaluator",
        "seconds": run.seconds,
        "evaluations_per_second": evaluations / run.seconds if run.seconds > 0 else 0.0,
        "objectives": ["regularity", searched(run)],
        "hypervolume": volume,
        "stop_reason": run.stop_reason,
        "evaluator": run.evaluator.backend,
        "threads": run.threads,
        "search_vertices": len(run.searched.vertices),
        "search_differences": run.differences,
        "notes": run.scenario.notes,
        "warnings": run.warnings,
    }


def of_parts(parts: Parts) -> dict[str, Any]:
    """What `summary.json` holds of the parts of a run before it has done anything: all that its setups are made of."""
    scenario, mirror = parts.scenario, parts.scenario.mirror
    plane, objectives = scenario.planar, scenario.objectives
    return {
        "scenario": scenario.name,
        "kernel": parts.kernel.name,
        "support": parts.kernel.support,
        "representation": {"name": parts.representation.name, **parts.representation.spec()},
        "manipulation": parts.settings.manipulation,
        "centers": parts.settings.centers,
        **({"kept": len(parts.kept)} if len(parts.kept) else {}),
        "criterion_norm": parts.norm,
        "gradient_norm": finite(scenario.gradient_norm) if objectives is None else None,
        "gradient_is": "direction" if scenario.direction_only else "displacement",
        "objective": scenario.objective,
        **({} if objectives is None else of_each(objectives)),
        "smooth": scenario.smooth,
        "symmetry": None if mirror is None else {"axis": "xyz"[mirror.axis], "at": mirror.at},
        "hold_width": None if scenario.hold is None else scenario.hold.width,
        "planar": None if plane is None else {"axis": plane.name, "at": plane.at},
        "up": scenario.up,
        "vertices": len(scenario.vertices),
    }


def searched(run: Run) -> str:
    """The column of setups.npz that was searched beside regularity."""
    if run.scenario.objectives is not None and run.scenario.objectives.worst:
        return "worst_potential"
    return "improvement_potential" if run.norm == 2.0 else "bounded_potential"


def of_each(objectives: Objectives) -> dict[str, Any]:
    """What is known of each of several objectives, in the order of `gradients` in scenario.npz."""
    keys = ("name", "source", "objective", "share", "gradient_norm")
    norms = map(finite, objectives.norms)
    rows = zip(objectives.names, objectives.sources, objectives.directions, objectives.shares, norms, strict=True)
    listed = [dict(zip(keys, row, strict=True)) for row in rows]
    return {"combine": "worst" if objectives.worst else "mean", "sensitivities": listed}


def finite(value: float) -> float | None:
    """A number as JSON has it."""
    return value if math.isfinite(value) else None


def differences(searched: Sequence[Rows], final: Sequence[Rows]) -> dict[str, float] | None:
    """How far scores on a search's vertices were from those on all: (R' - R)/R and P' - P, R' and P' the search's.

    Medians show the bias, the others the largest size; g is scaled so that P fits for random setups. None where there
    are no rows.
    """
    if not searched:
        return None
    before, after = (torch.cat([row.scores.objectives for row in rows]) for rows in (searched, final))
    relative = (before[:, 0] - after[:, 0]) / after[:, 0].clamp_min(1e-12)
    absolute = before[:, 1] - after[:, 1]
    return {
        "regularity_median": float(relative.median()),
        "regularity_largest": float(relative.abs().max()),
        "improvement_potential_median": float(absolute.median()),
        "improvement_potential_largest": float(absolute.abs().max()),
    }


def describe(device: torch.device) -> str:
    """The name of the device: `cpu`, or `cuda (NVIDIA ...)`."""
    return f"cuda ({torch.cuda.get_device_name(device)})" if device.type == "cuda" else device.type


def versions() -> dict[str, str]:
    """Versions of what the numbers of a run depend on."""
    packages = ("rbfevo", "torch", "numpy", "scipy", "numba", "trimesh", "pyvista", "hydra-core", "mne")
    installed = {package: version for package in packages if (version := _version(package)) is not None}
    return {"python": platform.python_version(), **installed}


@functools.cache
def _version(package: str) -> str | None:
    """The version of an installed package, which is read from a file once."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
