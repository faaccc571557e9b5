"""Setups that somebody has placed by hand, scored beside those that are searched."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.method import Heuristic, Problem, Rows, files_of
from rbfevo.scenarios.control_points import files_in, read_centers
from rbfevo.scenarios.scenario import Scenario


class GivenCenters(Heuristic):
    """Control points from files, one setup a file, exactly where they are.

    Args:
        centers: a file, or a list of files, as `rbfevo.scenarios.control_points.read_centers` takes them; a directory
            that is no export stands for the CSV files in it.

    Attributes:
        files: these; labels: [p] a short name of each; inputs: [p, m, d] their centers, once `bring` has read them.

    Raises:
        UserError: if no file is named, or one twice.
    """

    name = "given"
    brings = True

    def __init__(self, centers: Any = None) -> None:
        super().__init__()
        asked = files_of("method.centers", centers)
        self.files = files_of("method.centers", [file for path in asked for file in files_in(path)])
        self.labels = labels_of(self.files)
        self.inputs: Tensor | None = None

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        return len(self.files)

    def bring(self, scenario: Scenario) -> tuple[int, dict[str, str]]:
        """Read the files; return how many centers each setup has, and notes by title.

        Raises:
            UserError: if a file cannot be used on the scenario, or not all have the same number of centers.
        """
        found = [read_centers(file, scenario) for file in self.files]
        counts = [len(one.centers) for one in found]
        if len(set(counts)) > 1:
            listed = ", ".join(f"{file} has {count}" for file, count in zip(self.files, counts, strict=True))
            raise UserError(
                f"method.centers: all setups of a run have the same number of centers, but of these files {listed}; "
                "with -m and without the brackets each file gets a run of its own"
            )
        self.inputs = torch.stack([torch.from_numpy(one.centers.copy()) for one in found])
        return counts[0], {
            f"centers {label}": f"{file}: {'; '.join([f'{count} centers', *one.notes])}"
            for label, file, count, one in zip(self.labels, self.files, counts, found, strict=True)
        }

    def place(self, problem: Problem) -> Tensor:
        """[p, m, d], or [p, *setup] of a representation that reads files of its own.

        Raises:
            UserError: if a file cannot be used, setups do not consist of centers, or one has no columns.
        """
        made = problem.representation.given(self.files, problem.scenario)
        if made is not None:
            self.inputs = made
            return made
        if self.inputs is None:
            self.bring(problem.scenario)
        setups = None if self.inputs is None else problem.representation.assemble(self.inputs)
        if setups is None:
            raise UserError(
                f"method={self.name} takes centers, and representation={problem.representation.name} has none"
            )
        for file, one in zip(self.files, setups, strict=True):
            if not bool(problem.representation.phi(problem.scenario.vertices[:1], one).isfinite().all()):
                raise UserError(f"{file}: this setup cannot be scored: {problem.representation.fails_where}")
        return setups

    def rows(self) -> list[Rows]:
        """One row a file, labelled with it."""
        return [rows._replace(labels=self.labels) for rows in super().rows()]


def labels_of(files: Sequence[str]) -> tuple[str, ...]:
    """A short name of each file: without ending and directory, of an export its directory; longer ones where needed."""
    paths = [Path(file) for file in files]
    short = [path.parent.name if path.stem == "centers" and path.parent.name else path.stem for path in paths]
    if len(set(short)) < len(short):
        short = ["/".join(path.parts[-2:]) for path in paths]
    return tuple(short if len(set(short)) == len(short) else files)
