"""The arrays and the summary of a run directory, read without torch and checked.

Figures, picks and fits read a run through this module alone, so that they work on any run at any time.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from rbfevo.arrays import Array
from rbfevo.errors import UserError
from rbfevo.scoring.fronts import knee_of

SETUPS = ("centers", "regularity", "improvement_potential", "method", "preference", "nondominated")
OF_EACH = ("potentials", "bounded_potentials", "worst_potential")  # of setups.npz, where there are several objectives
SCENARIO = ("vertices", "faces", "gradient", "weights", "lower", "upper")
LISTED = 4  # objectives at most that a line names
PLAIN = "improvement potential"  # what is searched, unless a norm other than 2 or several objectives are asked for


@dataclasses.dataclass(frozen=True)
class Record:
    """A run as its files hold it (NumPy, float64): p setups of m centers in d dimensions, a mesh of n vertices.

    Attributes:
        centers: [p, m, d], model units.
        regularity, improvement_potential: [p], NaN where a setup has no score.
        method, preference, nondominated: [p]; preference is NaN where there is none.
        vertices, faces, gradient, weights: [n, d], [f, 3], [n, k] of unit (weighted) norm, [n]. Of J objectives the
            gradient is [n, J k]: those of all, each times the root of its share. `alone` has that of one.
        lower, upper: [d] corners of the box.
        summary: summary.json.
        stays: [n] bool, vertices that should not move; None if the run did not save it.
        variability: [p] rank(U)/n; None if the run did not save it.
        blend: [n] what rows of U are multiplied by, 0 where a vertex is held, and the held points [h, d]; None without.
        genotype: [p, D] setups of another representation than RBFs, whose `centers` are where control points sit.
        gradient_raw: [n, k] the gradient before smoothing, in the scale of `gradient`; None without smoothing.
        max_displacement: [n] how far each vertex may move at most, model units; None without bounds.
        label: [p] names of setups that have one, such as the files of `method=given`, else empty; None where none has.
        bounded_potential: [p] P_p where `criterion.norm` is not 2; then it is what was searched; else None.
        gradients: [J, n, k] of each of several objectives, of unit norm; potentials, bounded_potentials: [p, J] P and
            P_p of each; worst_potential: [p] the least of those searched, where it was searched. None where there are
            none.
    """

    centers: Array
    regularity: Array
    improvement_potential: Array
    method: Array
    preference: Array
    nondominated: Array
    vertices: Array
    faces: Array
    gradient: Array
    weights: Array
    lower: Array
    upper: Array
    summary: dict[str, Any]
    stays: Array | None = None
    variability: Array | None = None
    genotype: Array | None = None
    blend: Array | None = None
    held: Array | None = None
    gradient_raw: Array | None = None
    bounded_potential: Array | None = None
    label: Array | None = None
    max_displacement: Array | None = None
    gradients: Array | None = None
    potentials: Array | None = None
    bounded_potentials: Array | None = None
    worst_potential: Array | None = None

    def origin(self, row: int) -> str:
        """The method of a row, with the name of its setup where it has one."""
        name = "" if self.label is None else str(self.label[row])
        return f"{self.method[row]}{name and f' ({name})'}"

    @property
    def objectives(self) -> tuple[str, ...]:
        """The names of several objectives; none where there is only one."""
        return tuple(entry["name"] for entry in self._sensitivities)

    @property
    def shares(self) -> Array:
        """[J] the shares of several objectives in the gradient's squared norm, of sum 1."""
        return np.array([entry["share"] for entry in self._sensitivities], dtype=np.float64)

    @property
    def _sensitivities(self) -> list[dict[str, Any]]:
        """What summary.json has of each of several objectives."""
        return [] if self.gradients is None else self.summary["sensitivities"]

    def alone(self, index: int) -> Record:
        """The run with one of several objectives: its gradient and potentials in the place of the run's."""
        if self.gradients is None or self.potentials is None:
            return self
        entry, k = self._sensitivities[index], self.gradients.shape[2]
        of_summary = {key: entry.get(key) for key in ("gradient_norm", "objective")}
        raw, bounded = self.gradient_raw, self.bounded_potentials
        columns = slice(index * k, (index + 1) * k)
        return dataclasses.replace(
            self,
            gradient=self.gradients[index],
            gradient_raw=None if raw is None else raw[:, columns] / np.sqrt(entry["share"]),
            improvement_potential=self.potentials[:, index],
            bounded_potential=None if bounded is None else bounded[:, index],
            summary={key: self.summary[key] for key in self.summary if key != "sensitivities"} | of_summary,
            **dict.fromkeys(("gradients", *OF_EACH)),
        )

    def each(self) -> list[Record]:
        """The run once for each objective; itself where there is only one."""
        return [self.alone(index) for index in range(max(1, len(self._sensitivities)))]

    @property
    def kept(self) -> int:
        """How many centers, the first ones of each setup, the run kept."""
        kept = self.summary.get("kept", 0)
        return kept if isinstance(kept, int) else 0

    @property
    def potential(self) -> Array:
        """[p] the potential that was searched with regularity: P, bounded potential, or the least of several."""
        if self.worst_potential is not None:
            return self.worst_potential
        return self.improvement_potential if self.bounded_potential is None else self.bounded_potential

    @property
    def potential_of_each(self) -> Array:
        """[p, J] that of each of several objectives, of which `potential` is the weighted mean, or the least."""
        found = self.potentials if self.bounded_potentials is None else self.bounded_potentials
        return np.zeros((len(self.regularity), 0)) if found is None else found

    @property
    def potential_name(self) -> str:
        """What pictures call it."""
        p, name = self.summary.get("criterion_norm"), PLAIN
        if self.bounded_potential is not None:
            name = f"bounded potential (p = {p:g})" if isinstance(p, int | float) else "bounded potential"
        return f"{self._combined}{name}"

    @property
    def potential_symbol(self) -> str:
        """P, or P_16; of several objectives mean P, or min P."""
        return f"{self._combined.replace('minimum', 'min')}{self.symbol_of_each}"

    @property
    def symbol_of_each(self) -> str:
        """P, or P_16, of one objective."""
        p = self.summary.get("criterion_norm")
        if self.bounded_potential is None:
            return "P"
        return f"P_{p:g}" if isinstance(p, int | float) else "P_p"

    @property
    def _combined(self) -> str:
        """What the names of potentials begin with."""
        return "" if self.gradients is None else "mean " if self.worst_potential is None else "minimum "

    @property
    def combination(self) -> str:
        """How several objectives are combined, such as `mean of drag (0.667), lift (0.333)`; empty of one."""
        if self.gradients is None:
            return ""
        shares = [""] * len(self.shares) if self.worst_potential is not None else [f" ({s:.3g})" for s in self.shares]
        names = [f"{name}{share}" for name, share in zip(self.objectives, shares, strict=True)]
        more = f" and {len(names) - LISTED} more" if len(names) > LISTED else ""
        return f"{self._combined}of {', '.join(names[:LISTED])}{more}"

    def listed(self, row: int) -> str:
        """The potential of each of several objectives of a setup, in a line; empty where there is only one."""
        return ", ".join(
            f"{name} {value:.4f}" for name, value in zip(self.objectives, self.potential_of_each[row], strict=True)
        )

    @property
    def scored(self) -> Array:
        """[p] True where both scores are finite."""
        return np.isfinite(self.regularity) & np.isfinite(self.potential)

    @property
    def usable(self) -> Array:
        """Indices of the setups with finite scores and finite centers."""
        finite = np.isfinite(self.centers).all(axis=(1, 2))
        if self.genotype is not None:
            finite &= np.isfinite(self.genotype).all(axis=1)
        return np.flatnonzero(self.scored & finite)

    @property
    def front(self) -> Array:
        """Indices of the nondominated setups, by rising regularity, the better one first where it ties."""
        members = np.flatnonzero(self.nondominated & self.scored)
        return members[np.lexsort((-self.potential[members], self.regularity[members]))]

    @property
    def gradient_norm(self) -> float | None:
        """The norm that the gradient had before it was scaled to 1, in model units.

        None if the run did not save it, or has a sensitivity, which gives a direction only.
        """
        norm = None if self.summary.get("gradient_is") == "direction" else self.summary.get("gradient_norm")
        return float(norm) if isinstance(norm, int | float) and np.isfinite(norm) and norm > 0 else None

    @property
    def title(self) -> str:
        """Scenario, kernel, support radius and manipulation in one line."""
        entry = self.summary.get
        name = str(entry("kernel", "unknown"))
        kernel = f"{'Wendland' if name == 'wendland' else name} kernel"
        if entry("support") is not None:
            kernel += f", support radius {entry('support'):.4g}"
        spec = entry("representation")
        numbers = spec.get("kernel") if isinstance(spec, dict) else None
        if isinstance(numbers, dict) and isinstance(numbers.get("scale"), float):
            kernel += f", scale {numbers['scale']:.4g}"
        if isinstance(spec, dict) and "linear" in spec:
            kernel += " with a linear polynomial"
        if isinstance(spec, dict) and spec.get("name", "rbf") != "rbf":
            kernel = f"representation {spec['name']}"
            if isinstance(counts := spec.get("lattice"), list):
                kernel += f", lattice {' x '.join(map(str, counts))}"
        return f"{entry('scenario', 'unknown')} · {kernel} · {entry('manipulation', 'unknown')} manipulation"


def read(run: Path, meshes: dict[bytes, dict[str, Array]] | None = None) -> Record:
    """Read setups.npz, scenario.npz and summary.json of the run directory `run`.

    Args:
        meshes: the arrays of each scenario.npz that was read before, by a hash of the file; equal files share them.

    Raises:
        UserError: if one of them is missing, unreadable, or does not fit the others.
    """
    if not run.is_dir():
        raise UserError(f"{run}: {'is a file, not a' if run.exists() else 'there is no such'} run directory")
    optional = ("variability", "genotype", "bounded_potential", "label", *OF_EACH)
    setups = _arrays(run / "setups.npz", SETUPS, optional)
    of_vertices = ("stays", "blend", "held", "gradient_raw", "gradients", "max_displacement")
    scenario = _arrays(run / "scenario.npz", SCENARIO, of_vertices, meshes)
    stays = scenario.pop("stays", None)
    summary = _load(run / "summary.json", lambda path: json.loads(path.read_text(encoding="utf-8")))
    p, n = len(setups["regularity"]), len(scenario["vertices"])
    fitting = (
        setups["centers"].ndim == 3
        and all(len(array) == p for array in setups.values())
        and setups["centers"].shape[2] == scenario["vertices"].shape[1]
        and scenario["gradient"].ndim == 2
        and all(len(scenario[key]) == n for key in ("gradient", "weights"))
        and (stays is None or stays.shape == (n,))
        and ("blend" not in scenario or scenario["blend"].shape == (n,))
        and ("max_displacement" not in scenario or scenario["max_displacement"].shape == (n,))
        and ("blend" in scenario) == ("held" in scenario)
        and scenario.get("gradient_raw", scenario["gradient"]).shape == scenario["gradient"].shape
        and isinstance(summary, dict)
        and _fitting_objectives(setups, scenario, summary)
    )
    if not fitting:
        raise UserError(f"{run}: setups.npz, scenario.npz and summary.json do not match; restore the files of one run")
    setups["method"], setups["nondominated"] = setups["method"].astype(str), setups["nondominated"].astype(bool)
    return Record(**setups, **scenario, summary=summary, stays=None if stays is None else stays.astype(bool))


def _fitting_objectives(setups: dict[str, Array], scenario: dict[str, Array], summary: dict[str, Any]) -> bool:
    """Whether all files hold the same number of several objectives, or none of them any."""
    entries, fields = summary.get("sensitivities"), scenario.get("gradients")
    if entries is None or fields is None:
        return entries is None and fields is None and not any(name in setups for name in OF_EACH)
    if not isinstance(entries, list) or fields.ndim != 3 or len(entries) != len(fields) or len(fields) < 2:
        return False
    named = all(
        isinstance(entry, dict) and isinstance(entry.get("name"), str) and isinstance(entry.get("share"), float)
        for entry in entries
    )
    (count, n, k), p = fields.shape, len(setups["regularity"])
    bounded = setups.get("bounded_potentials")
    return (
        named
        and scenario["gradient"].shape == (n, count * k)
        and "potentials" in setups
        and setups["potentials"].shape == (p, count)
        and (bounded is None or bounded.shape == (p, count))
        and (bounded is None) == ("bounded_potential" not in setups)
    )


FIT = ("centers", "parameters", "deformed", "local_error", "moved_centers")


@dataclasses.dataclass(frozen=True)
class FitRecord:
    """A fit as its files hold it (NumPy, float64), and the run that its setup comes from.

    Attributes:
        deformed: [n, 3] vertices of the deformed design; on a plane the height is the third coordinate.
        local_error: [n] the length of the residual at each vertex, model units; moved_centers: [m, 3].
        errors: [generations + 1] errors of the mean, the start first; centers, parameters: [m, d], [m, k].
        summary: fit.json.
    """

    run: Record
    centers: Array
    parameters: Array
    deformed: Array
    local_error: Array
    moved_centers: Array
    errors: Array
    summary: dict[str, Any]


def read_fit(directory: Path) -> FitRecord:
    """Read fit.json, parameters.npz and history.csv of a fit, and the run directory that fit.json names.

    Raises:
        UserError: if one of them is missing, unreadable, or does not fit the others.
    """
    summary = _load(directory / "fit.json", lambda path: json.loads(path.read_text(encoding="utf-8")))
    arrays = _arrays(directory / "parameters.npz", FIT)
    lines = _load(directory / "history.csv", lambda path: np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2))
    if not isinstance(summary, dict) or not isinstance(summary.get("run"), str) or lines.shape[1] != 3:
        raise UserError(f"{directory}: fit.json and history.csv are not the files of a fit")
    run = read((directory / summary["run"]).resolve())
    n, m = len(run.vertices), len(arrays["centers"])
    fitting = arrays["deformed"].shape == (n, 3) and len(arrays["local_error"]) == n
    if not fitting or arrays["moved_centers"].shape != (m, 3):
        raise UserError(
            f"{directory}: the arrays of this fit do not match those of its run {summary['run']}; repeat the fit"
        )
    return FitRecord(run=run, **arrays, errors=lines[:, 1], summary=summary)


def knee(record: Record) -> int | None:
    """The nondominated row farthest from the chord between the front's ends, the lowest of equals; None without."""
    rows = np.flatnonzero(record.nondominated & record.scored)
    if rows.size == 0:
        return None
    scores = np.stack([record.regularity[rows], record.potential[rows]], axis=1)
    return int(rows[knee_of(scores)])


def _arrays(
    path: Path,
    names: tuple[str, ...],
    optional: tuple[str, ...] = (),
    shared: dict[bytes, dict[str, Array]] | None = None,
) -> dict[str, Array]:
    def load(path: Path) -> dict[str, Array]:
        """The arrays of an archive, by name; those of an equal file that was read before are shared."""
        content = path.read_bytes()
        known = hashlib.blake2b(content).digest()
        if shared is not None and known in shared:
            return dict(shared[known])
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in (*names, *(name for name in optional if name in archive))}
        if shared is not None:
            shared[known] = arrays
        return dict(arrays)

    return _load(path, load)


def _load(path: Path, load: Any) -> Any:
    try:
        return load(path)
    except FileNotFoundError:
        raise UserError(f"{path} is missing: is {path.parent} a finished run?") from None
    except KeyError as error:
        raise UserError(f"{path} cannot be used: {error.args[0]}") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise UserError(f"{path} cannot be read: damaged? ({' '.join(str(error).split())})") from None
