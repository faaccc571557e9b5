"""The rule of `rbfevo.advise`: from gains to one kernel, support radius and number of centers, and the reasons.

docs/advise.md explains the rule. Plain numbers, no torch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from rbfevo.errors import UserError
from rbfevo.scoring.fronts import enough_of

ALIKE = 0.98  # of the best gain with that number: what the largest radius has to reach


class Trial(NamedTuple):
    """Gains, maximized, of setups of one kernel, support radius and number of centers; NaN where none was tried.

    Attributes:
        kernel: as on the command line; support: radius, model units, or None for a kernel that reaches everywhere.
        centers: m.
        nested, optimized, lloyd: the gain of the nested sequence, of the best climb, of Lloyd's centers.
    """

    kernel: str
    support: float | None
    centers: int
    nested: float
    optimized: float
    lloyd: float

    @property
    def gain(self) -> float:
        """The largest of the three."""
        return max((gain for gain in self[3:] if math.isfinite(gain)), default=-math.inf)

    @property
    def reach(self) -> float:
        """The support radius, infinite for a kernel that reaches everywhere."""
        return math.inf if self.support is None else self.support


class Choice(NamedTuple):
    """The trial that the rule takes, and the one of the largest gain."""

    trial: Trial
    most: Trial


def choose(trials: Sequence[Trial]) -> Choice:
    """Apply the rule.

    Raises:
        UserError: if no setup gains anything.
    """
    useful = [trial for trial in trials if trial.gain > 0.0]
    if not useful:
        raise UserError("none of the setups tried moves the design in the wanted direction")
    most = max(useful, key=lambda trial: (trial.gain, -trial.centers))
    number = enough_of([trial.centers for trial in useful], [trial.gain for trial in useful])
    rivals = [trial for trial in useful if trial.centers == number]
    best = max(trial.gain for trial in rivals)
    alike = [trial for trial in rivals if trial.gain >= ALIKE * best]
    local = [trial for trial in alike if trial.support is not None]
    return Choice(max(local or alike, key=lambda trial: (trial.reach, trial.gain)), most)


def reasons(trials: Sequence[Trial], choice: Choice) -> list[str]:
    """Why, in sentences: beside the largest gain, beside Lloyd's centers, and a larger radius beside more centers."""
    trial, most = choice
    found = []
    if trial == most:
        found.append(f"{_setup(trial)} reach{_s(trial)} the largest gain of all setups tried, {trial.gain:.3f}")
    else:
        share = f"{trial.gain / most.gain:.0%} of the largest gain of all setups tried, {most.gain:.3f}"
        found.append(f"{_setup(trial)} reach{_s(trial)} {share}, that of {_setup(most)}")
    if trial.centers == max(other.centers for other in trials):
        found.append(f"{trial.centers} is the most that was tried; more may gain more: centers={2 * trial.centers}")
    spread = [other for other in trials if math.isfinite(other.lloyd) and other[:3] == trial[:3]]
    if spread:
        found.append(
            f"with the same number and radius, centers spread evenly (Lloyd) reach {spread[0].lloyd / most.gain:.0%}"
        )
    return found + _doubled(trials, trial)


def _doubled(trials: Sequence[Trial], trial: Trial) -> list[str]:
    """What twice the radius and twice the centers bring, from about half of both."""
    if trial.support is None:
        return []
    here = {(other.centers, other.support): other.gain for other in trials if other.kernel == trial.kernel}
    radii = sorted({radius for _, radius in here if radius is not None})
    pairs = [(r, q) for r in radii for q in radii if abs(q / r - 2.0) < 1e-6]
    numbers = sorted({m for m, _ in here})
    steps = [
        (r, q, m)
        for r, q in pairs
        for m in numbers
        if 2 * m in numbers and all((n, s) in here for n, s in ((m, r), (m, q), (2 * m, r)))
    ]
    if not steps:
        return []
    goal = math.log(trial.support / 2.0), math.log(trial.centers / 2.0)
    r, q, m = min(steps, key=lambda step: (math.log(step[0]) - goal[0]) ** 2 + (math.log(step[2]) - goal[1]) ** 2)
    base, wider, more = here[m, r], here[m, q], here[2 * m, r]
    if not base > 0.0:
        return []
    verdict = (
        "worth more than" if wider > more * 1.005 else "worth less than" if more > wider * 1.005 else "worth as much as"
    )
    return [
        f"twice the radius is {verdict} twice the centers: from {m} with radius {r:.4g}, radius {q:.4g} brings "
        f"{wider / base - 1.0:+.0%}, and {2 * m} centers {more / base - 1.0:+.0%}"
    ]


def _setup(trial: Trial) -> str:
    """A trial in a sentence."""
    radius = "" if trial.support is None else f", radius {trial.support:.4g}"
    return f"{trial.centers} center{'s' * (trial.centers != 1)} ({trial.kernel}{radius})"


def _s(trial: Trial) -> str:
    return "es" if trial.centers == 1 else ""
