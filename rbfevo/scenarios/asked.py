"""What `scenario.sensitivity` and the keys beside it ask for, of one objective or of several."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rbfevo.errors import UserError
from rbfevo.names import file_and_name
from rbfevo.scenarios.boundaries import field_of
from rbfevo.scenarios.objectives import Objectives
from rbfevo.scenarios.sensitivities import Choices
from rbfevo.scenarios.templates import Template

COMBINES = ("mean", "worst")


@dataclasses.dataclass(frozen=True)
class Asked:
    """What `scenario.sensitivity` and the keys beside it ask for, checked.

    Attributes:
        sources: the sensitivities, none where none is named; choices: those of each, of one where none is named.
        weights: positive ones, one each; worst: as for `Objectives`; names: those given, or None.
    """

    sources: tuple[str, ...]
    choices: tuple[Choices, ...]
    weights: tuple[float, ...]
    worst: bool
    names: tuple[str, ...] | None

    @staticmethod
    def of(
        sensitivity: Any,
        kind: Any,
        normal: Any,
        match: Any,
        objective: Any,
        weights: Any = None,
        names: Any = None,
        combine: str = "mean",
    ) -> Asked:
        """Check the keys: one value of each for all sensitivities, or a list with one for each.

        Raises:
            UserError: for a list of another length, a weight that is not positive, weights where the least potential is
                searched, names that are equal, or anything else that is no valid choice.
        """
        sources = _sources(sensitivity)
        count = max(len(sources), 1)
        if combine not in COMBINES:
            raise UserError(f"scenario.combine={combine}: choose one of {', '.join(COMBINES)}")
        several = {"objective_weights": weights is not None, "objective_names": names is not None}
        several["combine"] = combine != COMBINES[0]
        for key in (key for key, there in several.items() if there and count == 1):
            raise UserError(f"scenario.{key} is for several sensitivities, scenario.sensitivity=[A,B]; leave it out")
        keys = {"sensitivity_kind": kind, "sensitivity_normal": normal, "sensitivity_match": match}
        columns = [_each(key, value, count) for key, value in {**keys, "objective": objective}.items()]
        choices = tuple(Choices(*row) for row in zip(*columns, strict=True))
        worst = combine == "worst"
        if worst and weights is not None:
            raise UserError(
                "scenario.objective_weights: scenario.combine=worst takes the least of the potentials, which no weight "
                "changes; leave one of the two out"
            )
        found = _weights(_each("objective_weights", 1.0 if weights is None else weights, count))
        return Asked(sources, choices, found, worst, None if names is None else _names(names, count))

    def objectives(self, template: Template, norms: Sequence[float]) -> Objectives | None:
        """The objectives on a template, None of one; norms: those that their sensitivities had."""
        if len(self.sources) < 2:
            return None
        total = math.fsum(self.weights)
        shares = tuple(weight / total for weight in self.weights)
        directions = tuple(choices.objective for choices in self.choices)
        return Objectives(self.titles(template), self.sources, directions, shares, self.worst, tuple(norms))

    def fields(self, template: Template) -> list[str]:
        """The sensitivities with arrays in the place of adjoint solvers of a case: the best one of each.

        Raises:
            UserError: if two of them are the same then.
        """
        found = [field_of(template, source) for source in self.sources]
        for field in found:
            if found.count(field) > 1:
                raise UserError(f"scenario.sensitivity: {', '.join(self.sources)} name {field} twice; give it once")
        return found

    def titles(self, template: Template) -> tuple[str, ...]:
        """A name for each: as given, else that of its array or file, as long as it takes to tell them apart.

        Of an OpenFOAM case it is the name of the adjoint solver. One alone has none, and it is empty.
        """
        if len(self.sources) < 2:
            return ("",)
        if self.names is not None:
            return self.names
        levels = list(zip(*(_called(source, template) for source in self.sources), strict=True))
        return next((level for level in levels if len(set(level)) == len(level)), self.sources)


def _sources(value: Any) -> tuple[str, ...]:
    """The sensitivities that are listed, or the one that is named.

    Raises:
        UserError: for an empty list, an entry that is no name, or one that is listed twice.
    """
    if value is None:
        return ()
    listed = list(value) if isinstance(value, Sequence) and not isinstance(value, str) else [value]
    if not listed:
        raise UserError("scenario.sensitivity=[]: name at least one sensitivity, or give null")
    wrong = [entry for entry in listed if not isinstance(entry, str | int | float) or isinstance(entry, bool)]
    if wrong or "" in listed:
        entry = wrong[0] if wrong else "an empty name"
        raise UserError(f"scenario.sensitivity: {entry} is not the name of an array or a file")
    names = [str(entry) for entry in listed]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"scenario.sensitivity: {name} is listed {names.count(name)} times; give it once")
    return tuple(names)


def _each(key: str, value: Any, count: int) -> list[Any]:
    """A value for each of so many sensitivities.

    Raises:
        UserError: if it is a list of another length.
    """
    if not isinstance(value, Sequence) or isinstance(value, str):
        return [value] * count
    if len(value) != count:
        listed = f"{count} sensitivit{'y' if count == 1 else 'ies'}"
        shown = ",".join(str(entry) for entry in value)
        raise UserError(
            f"scenario.{key}=[{shown}]: {len(value)} value{'s' * (len(value) != 1)} for {listed}; give one for each, "
            "or a single one for all"
        )
    return list(value)


def _weights(values: Sequence[Any]) -> tuple[float, ...]:
    for value in values:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not 0.0 < value < math.inf:
            raise UserError(
                f"scenario.objective_weights: {value} is not a positive number; for an objective that is only to be "
                "reported give a small one, such as 1e-6"
            )
    return tuple(float(value) for value in values)


def _names(value: Any, count: int) -> tuple[str, ...]:
    listed = [str(name).strip() for name in _each("objective_names", value, count)]
    if not all(listed) or len(set(listed)) < len(listed):
        raise UserError(f"scenario.objective_names=[{','.join(listed)}]: give each objective a name of its own")
    return tuple(listed)


def _called(source: str, template: Template) -> tuple[str, ...]:
    """Names of a sensitivity, from the shortest to the longest."""
    field = field_of(template, source)
    if field in template.arrays or field in template.cell_arrays:
        meaning = template.meanings.get(field)
        return ((meaning and meaning.solver) or field, *[field] * 3)
    file, named = file_and_name(source)
    path = Path(file)
    stem = path.stem or source
    above = f"{path.parent.name}/{stem}" if path.parent.name else stem
    if named:
        return named, f"{stem}:{named}", f"{above}:{named}", source
    return stem, above, above, source
