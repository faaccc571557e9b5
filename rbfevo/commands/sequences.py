"""The nested sequences that a sweep's page shows beside its runs: known ones are read, the others computed once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rbfevo.errors import UserError
from rbfevo.recorded.sweep import Member, NestedSequence, sequences

if TYPE_CHECKING:
    from rbfevo.runs.config import Settings
    from rbfevo.runs.sequence import Picks

METHOD = {"_target_": "rbfevo.methods.OlsHeuristic"}
MOST = 100  # centers


def collected(
    members: Sequence[Member],
    meshes: Sequence[str],
    directory: Path,
    out: Path,
    most: int,
    report: Callable[[str], None],
) -> tuple[list[NestedSequence], list[str]]:
    """The sequences of up to `most` centers that runs on some meshes call for, and why some cannot be had, a line each.

    A sequence is taken from an earlier collection in `out`, else from a run of `method=ols` with enough centers, else
    computed, in seconds to minutes; where that fails the longest one of a run is taken.

    Args:
        directory: of the sweep, where the names of its runs begin; report: prints a line before each computation.
    """
    keys = sequences.shown_settings(members)
    wanted = sequences.wanted(members, meshes)
    before = sequences.read(out / sequences.FILE, wanted, keys)
    of_runs = sequences.of_runs(members, directory, keys)
    found, warnings, picked = [], [], _Picked(most)
    for key, member in wanted.items():
        known = [one for one in (before.get(key), of_runs.get(key)) if one is not None]
        whole = [one for one in known if len(one.points) >= most or one.note]
        if whole:
            found.append(sequences.cut(whole[0], most))
            continue
        try:
            found.append(_computed(key, member, directory / member.name, keys, picked, report))
        except Exception as error:  # whatever it is, the sweep has a page without it
            why = str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
            warnings.append(f"no nested OLS sequence for {member.name} and runs like it: {' '.join(why.split())}")
            found += sorted(known, key=lambda one: len(one.points))[-1:]
    return found, warnings


class _Picked:
    """Picks of up to `most` centers; runs that differ in the manipulation alone share them."""

    def __init__(self, most: int) -> None:
        self.most = most
        self._known: dict[str, Picks] = {}

    def of(self, settings: Settings, make: Callable[[], Picks]) -> Picks:
        """Those for some settings, made where they are not known yet."""
        alike = repr(dataclasses.replace(settings, manipulation="", seed=0, centers=0))
        if alike not in self._known:
            self._known[alike] = make()
        return self._known[alike]


def _computed(
    key: str, member: Member, run: Path, keys: Sequence[str], picked: _Picked, report: Callable[[str], None]
) -> NestedSequence:
    """The sequence of a run, on the scenario of its configuration.

    Raises:
        UserError: if the scenario cannot be built again as it was, or the representation does not consist of centers.
    """
    if member.record.genotype is not None:
        raise UserError("its representation does not consist of centers")
    report(f"nested OLS sequence of up to {picked.most} centers for {member.name} and runs like it ...")

    from rbfevo.runs import sequence
    from rbfevo.runs.assembly import Parts
    from rbfevo.runs.source import refuse_changed, settings_of

    of_run = settings_of(run)
    settings = dataclasses.replace(
        of_run,
        method=METHOD,
        centers=int(member.settings["centers"]),
        preferences=None,
        device="cpu",
        evaluator="eager",
    )
    parts = Parts(settings)
    refuse_changed(run, parts.scenario, member.record)
    if not sequence.is_scored(parts):
        raise UserError("the columns of its representation do not belong to one center each")
    picks = picked.of(settings, lambda: sequence.picks(parts, picked.most))
    table = sequence.table(parts, picks.centers, settings.manipulation)
    searched = {name: table[name].tolist() if name in table else None for name in sequences.SEARCHED}
    return NestedSequence(
        key=key,
        mesh=member.settings["mesh"],
        settings={name: member.settings.get(name) for name in keys},
        regularity=table["regularity"].tolist(),
        improvement_potential=table["improvement_potential"].tolist(),
        points=picks.centers.tolist(),
        note=picks.note,
        **searched,
    )
