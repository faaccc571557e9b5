"""The directory of a fit: fit.json, history.csv, parameters.npz and the deformed mesh, each whole or not at all."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.fit.manipulations import deformation
from rbfevo.fit.objective import residuals
from rbfevo.fit.source import Source
from rbfevo.fit.strategy import Fit
from rbfevo.runs.storage import csv_text, npz, write_whole
from rbfevo.scoring.representations import RBF, Representation

RESULTS = ("fit.json", "history.csv", "parameters.npz", "deformed.ply", "fit.png")


def write_fit(directory: Path, source: Source, centers: Tensor, fit: Fit, summary: dict[str, Any]) -> None:
    """Write the result of a fit: centers [m, d] of the setup, or another setup [D], and `fit`.

    `summary` is the contents of fit.json.

    Raises:
        UserError: if the directory cannot be made or written to.
    """
    scenario = source.scenario
    found = deformation(scenario, source.kernel, centers, summary["manipulation"])
    displacement = found.U @ fit.parameters
    weights = found.weights(fit.parameters)
    deformed = moved(scenario.vertices, displacement)
    handles, moves = _handles(source, centers, weights, found.W is not None)
    local_error = residuals(scenario, displacement).norm(dim=1).numpy()
    arrays = {
        "centers": handles.numpy(),
        "parameters": fit.parameters.numpy(),
        "manipulation": np.array(summary["manipulation"], dtype=np.str_),
        "weights": weights.numpy(),
        "deformed": deformed,
        "local_error": local_error,
        "moved_centers": moved(handles, moves),
    }
    lines = zip(range(len(fit.errors)), fit.errors.tolist(), fit.steps.tolist(), strict=True)
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{directory} cannot be created: {error.strerror or error}; choose another --out") from None
    write_whole(directory / "parameters.npz", npz(arrays))
    write_whole(directory / "history.csv", csv_text(("generation", "error", "step_size"), lines))
    write_whole(directory / "deformed.ply", ply(deformed, scenario.faces.numpy(), local_error))
    write_whole(directory / "fit.json", (json.dumps(summary, indent=2, allow_nan=False) + "\n").encode())


def _handles(source: Source, setup: Tensor, weights: Tensor, on_surface: bool) -> tuple[Tensor, Tensor]:
    """Centers of a setup [h, d] under weights [r, k], and how far they move; of a lattice its control points."""
    kernel, hold = source.kernel, source.scenario.hold
    if isinstance(kernel, Representation) and not on_surface:
        places = kernel.places(setup)
        return (setup.new_zeros(0, 3), weights[:0]) if places is None else (places, weights)
    found = kernel.handles(setup) if isinstance(kernel, Representation) else setup
    handles = setup.new_zeros(0, 3) if found is None else found
    columns = kernel.phi(handles, setup) if isinstance(kernel, Representation) else RBF(kernel).psi(setup)
    blend = 1.0 if hold is None else torch.from_numpy(hold(handles.numpy()))[:, None]
    return handles, blend * (columns @ weights)


def moved(points: Tensor, displacement: Tensor) -> NDArray[np.float64]:
    """Points [q, d] after a displacement [q, k], as [q, 3]; one of a plane's heights is the third coordinate."""
    if displacement.shape[1] == 1 and points.shape[1] == 2:
        return torch.cat([points, displacement], dim=1).numpy()
    return torch.nn.functional.pad(points + displacement, (0, 3 - points.shape[1])).numpy()


def ply(vertices: NDArray[np.float64], faces: NDArray[np.int64], local_error: NDArray[np.float64]) -> bytes:
    """A binary PLY file of a mesh, vertices in order, the local error [n] with them."""
    import trimesh
    from trimesh.exchange.ply import export_ply

    mesh = trimesh.Trimesh(vertices, faces, process=False, vertex_attributes={"local_error": local_error})
    return bytes(export_ply(mesh))
