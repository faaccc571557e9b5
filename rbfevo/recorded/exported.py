"""The setup.npz of an export, read back as a run of one setup."""

from __future__ import annotations

import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.recorded.record import Record
from rbfevo.scoring.kernels import kernel_of
from rbfevo.scoring.representations import RBF

NEEDED = (
    *("centers", "vertices", "faces", "lower", "upper", "kernel", "support", "manipulation"),
    *("symmetry_axis", "symmetry_at", "planar_axis", "planar_at", "regularity", "improvement_potential"),
)


def read_export(path: Path) -> tuple[Record, dict[bool, Array]]:
    """The one setup of a setup.npz as a run, and T of U = Q T for the columns along the symmetry plane and across it.

    What an export does not have is left out: the run's gradient is 0, and its vertices have no weights.

    Raises:
        UserError: if the file is missing or is no export, or its setup is not of RBFs.
    """
    try:
        archive = np.load(io.BytesIO(path.read_bytes()), allow_pickle=False)
        arrays = {} if isinstance(archive, np.ndarray) else dict(archive)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise UserError(f"{path} cannot be read: damaged? ({' '.join(str(error).split())})") from None
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        raise UserError(f"{path} is no setup.npz of rbfevo.export: it lacks {', '.join(missing)}")
    known = "kernel_spec" in arrays or arrays["kernel"].item() in ("wendland", "triharmonic")
    if "representation_spec" not in arrays and ("genotype" in arrays or not known):
        raise UserError(
            f"{path}: its representation, {arrays['kernel'].item()}, cannot be rebuilt from an export; give the run "
            "directory and a pick instead"
        )
    centers, vertices = arrays["centers"], arrays["vertices"]
    support = float(arrays["support"])
    summary = {
        "kernel": arrays["kernel"].item(),
        "support": None if np.isnan(support) else support,
        "manipulation": arrays["manipulation"].item(),
        "symmetry": _plane(arrays, "symmetry"),
        "planar": _plane(arrays, "planar"),
    }
    if "kernel_spec" in arrays:
        summary["representation"] = _representation(path, arrays["kernel_spec"])
    if "representation_spec" in arrays:
        try:
            summary["representation"] = json.loads(arrays["representation_spec"].item())
        except (ValueError, TypeError, AttributeError):
            raise UserError(f"{path} cannot be read: its representation_spec is damaged") from None
    if "held" in arrays:
        summary["hold_width"] = float(arrays["hold_width"])
    one, n = np.zeros(1), len(vertices)
    record = Record(
        centers=centers[None],
        regularity=arrays["regularity"].reshape(1),
        improvement_potential=arrays["improvement_potential"].reshape(1),
        method=np.array(["export"]),
        preference=one * np.nan,
        nondominated=np.ones(1, bool),
        vertices=vertices,
        faces=arrays["faces"],
        gradient=np.zeros((n, 1 if vertices.shape[1] == 2 else 3)),
        weights=np.ones(n),
        lower=arrays["lower"],
        upper=arrays["upper"],
        summary=summary,
        genotype=arrays["genotype"][None] if "genotype" in arrays else None,
        blend=arrays.get("blend"),
        held=arrays.get("held"),
    )
    return record, {across: arrays[name] for across, name in ((False, "T"), (True, "T_across")) if name in arrays}


def _representation(path: Path, kernel_spec: Array) -> dict[str, Any]:
    """The representation, as summary.json has it, of a kernel's numbers as JSON.

    Raises:
        UserError: if its kernel is not known here.
    """
    try:
        spec = json.loads(kernel_spec.item())
    except (ValueError, TypeError, AttributeError):
        raise UserError(f"{path} cannot be read: its kernel_spec is damaged") from None
    made = RBF(kernel_of(spec if isinstance(spec, dict) else {}))
    return {"name": made.name, **made.spec()}


def _plane(arrays: dict[str, Array], name: str) -> dict[str, object] | None:
    axis = arrays[f"{name}_axis"].item()
    return {"axis": axis, "at": float(arrays[f"{name}_at"])} if axis else None
