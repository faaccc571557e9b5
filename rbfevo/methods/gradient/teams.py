"""How setups that climb by gradient share the work: along a whole front, or for a list of preferences."""

from __future__ import annotations

import abc
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rbfevo.methods.gradient.lbfgs import LBFGS
from rbfevo.methods.gradient.tracing import Aim, Archive, Preference, Tchebycheff, WeightedSum, aim_of, front_normals
from rbfevo.scoring.fronts import preferred
from rbfevo.scoring.pareto import well_spread

TAU = 0.1
HOP = 0.02  # of the box: standard deviation of a hop away from the best setup of a preference
RANDOM, LLOYD, OLS = -1, 0, 1


class Team(abc.ABC):
    """Elements of one `LBFGS`: where each starts, what it aims at, where it is put next, and what all have found.

    Attributes:
        size: elements; aim: what they maximize now.
        points: [size, D] where they stand, in the unit box; standing: [size, 2] their objectives (R, P).
    """

    size: int
    aim: Aim
    points: Tensor
    standing: Tensor

    @abc.abstractmethod
    def origins(self) -> tuple[Tensor, Tensor]:
        """Where each element starts [size]: RANDOM, LLOYD or OLS, and how far scattered from there, 0 to 1."""

    @abc.abstractmethod
    def take(self, points: Tensor, objectives: Tensor) -> None:
        """Take points [size, D] that were tried, with objectives [size, 2], accepted or not."""

    @abc.abstractmethod
    def rescore(self, score: Callable[[Tensor], Tensor]) -> None:
        """The design has changed: `score` gives the objectives [p, 2] of points [p, D] on the new one."""

    @abc.abstractmethod
    def redeploy(self, climb: LBFGS, last: bool) -> LBFGS:
        """Put the elements where there is most to gain; before the last round, objectives of another design follow."""

    @abc.abstractmethod
    def found(self) -> tuple[Tensor, Tensor, Tensor]:
        """What has been found: points [p, D], objectives [p, 2], preference [p] (NaN where none)."""

    @abc.abstractmethod
    def progress(self) -> list[tuple[float, Tensor]]:
        """As `Method.progress`."""

    def state_dict(self) -> dict[str, Any]:
        """All that steps change, as tensors and numbers by name; copies."""
        return {"aim": self.aim.state_dict(), "standing": self.standing.clone()}

    def load_state_dict(self, state: dict[str, Any], climb: LBFGS) -> None:
        """Continue, bit for bit, where `state_dict` was taken, with the elements of `climb`."""
        self.aim, self.standing, self.points = aim_of(state["aim"]), state["standing"], climb.points

    def move(self, climb: LBFGS, tried: Tensor, objectives: Tensor, accepted: Tensor) -> None:
        """Note what was tried [size, D], its objectives [size, 2], and which of it was accepted [size]."""
        self.take(tried, objectives)
        self.points = climb.points
        before = self.standing if len(self.standing) == len(objectives) else objectives
        self.standing = torch.where(accepted[:, None], objectives, before)


class FrontTeam(Team):
    """Along the whole front: of the starts three eighths each for R and for P, which have many local maxima.

    After the first round `size` go on: three sixteenths for R, as many for P, the others between.
    """

    def __init__(self, starts: int, size: int, front: int, like: Tensor) -> None:
        self.size, self.front = size, front
        self.standing, self.points = like.new_zeros(0, 2), like.new_zeros(0, 0)
        self._alone, ends = 3 * size // 16, 3 * starts // 8
        golden = (torch.arange(starts, dtype=like.dtype, device=like.device) * (math.sqrt(5.0) - 1.0) / 2.0).frac()
        weights = golden.clone()
        weights[:ends], weights[starts - ends :] = 1.0, 0.0
        self.aim = WeightedSum(weights)
        self._scatter = golden.roll(starts // 2)
        self._kind = torch.full((starts,), OLS, device=like.device)
        self._kind[:ends:2], self._kind[1:ends:2] = RANDOM, LLOYD
        between = self._kind[ends : starts - ends]
        between[::3], between[1::6] = RANDOM, LLOYD
        self._archive: Archive | None = None

    def state_dict(self) -> dict[str, Any]:
        """The archive too."""
        return {**super().state_dict(), "archive": None if self._archive is None else self._archive.state_dict()}

    def load_state_dict(self, state: dict[str, Any], climb: LBFGS) -> None:
        """The archive too."""
        super().load_state_dict(state, climb)
        saved, self._archive = state["archive"], None
        if saved is not None:
            self._archive = Archive(saved["points"], limit=10 * self.front)
            self._archive.load_state_dict(saved)

    def origins(self) -> tuple[Tensor, Tensor]:
        """R from Lloyd and random setups, P from OLS, what lies between from all three."""
        return self._kind, self._scatter

    def take(self, points: Tensor, objectives: Tensor) -> None:
        """Keep what is nondominated."""
        if self._archive is None:
            self._archive = Archive(points, limit=10 * self.front)
        self._archive.add(points, objectives)

    def rescore(self, score: Callable[[Tensor], Tensor]) -> None:
        """The archive and where the elements stand."""
        self.standing = score(self.points)
        if self._archive is not None:
            before, self._archive = self._archive, None
            self._archive = Archive(before.points, limit=before.limit)
            self._archive.add(before.points, score(before.points), before.elements)

    def redeploy(self, climb: LBFGS, last: bool) -> LBFGS:
        """The two teams go on with their best; the others go where the front loses most without them.

        They take the place, and the quasi-Newton memory, of the element that met what they start from.
        """
        archive = self._archive
        if archive is None:
            return climb
        device = climb.points.device
        alone = 0 if last else 2 * self._alone
        count = self.size - alone
        rows = well_spread(archive.objectives, count)
        rows = rows[torch.arange(count, device=device) * len(rows) // count]  # a short front is shared
        normals, span = front_normals(archive.objectives, rows)
        points, ends, elements = archive.points[rows], archive.points[[0, -1]], archive.elements[rows]
        if last:
            normals[0], normals[-1] = normals.new_tensor([0.0, 1.0]), normals.new_tensor([1.0, 0.0])
            self.aim = Tchebycheff(normals, span, TAU)
            self._archive = None
            climb = climb.only(elements)
            climb.put(torch.arange(count, device=device), points)
            return climb
        free = torch.ones(len(self.standing), dtype=torch.bool, device=device)
        chosen: list[Tensor] = []
        for objective in (0, 1):
            order = self.standing[:, objective].where(free, -1.0).argsort(descending=True, stable=True)
            chosen.append(order[: self._alone])
            free[chosen[-1]] = False
        going = torch.cat((*chosen, elements))
        climb, self.standing = climb.only(going), self.standing[going]
        climb.restart(torch.tensor([self._alone - 1, alone - 1], device=device), ends.flip(0))
        climb.put(torch.arange(alone, self.size, device=device), points)
        # What the archive holds belongs to the element that starts next to it on the front.
        along = torch.searchsorted(rows, torch.arange(len(archive.elements), device=device))
        archive.elements = alone + along.clamp(max=count - 1)
        toward = normals.new_tensor([[1.0, 0.0], [0.0, 1.0]]).repeat_interleave(self._alone, 0)
        self.aim = Tchebycheff(torch.cat((toward, normals)), span, TAU)
        return climb

    def found(self) -> tuple[Tensor, Tensor, Tensor]:
        """`front` setups that keep most of the hypervolume."""
        if self._archive is None:
            return self.points[:0], self.standing[:0], self.standing[:0, 0]
        rows = well_spread(self._archive.objectives, self.front)
        none = torch.full_like(self._archive.objectives[rows, 0], math.nan)
        return self._archive.points[rows], self._archive.objectives[rows], none

    def progress(self) -> list[tuple[float, Tensor]]:
        """One line for the front."""
        return [] if self._archive is None else [(math.nan, self._archive.objectives)]


class WishTeam(Team):
    """A few elements for every preference, the worse half of which is replaced after each round.

    They hop around the preference's best, or come over from other preferences where theirs is good for this one too.
    """

    def __init__(self, size: int, preferences: Tensor, generator: torch.Generator) -> None:
        self._each = self.share(size, len(preferences))
        self.size = self._each * len(preferences)
        self.preferences = preferences
        self.standing, self.points = preferences.new_zeros(0, 2), preferences.new_zeros(0, 0)
        self._generator = generator
        self.aim = Preference(preferences.repeat_interleave(self._each))
        self._forget()

    @staticmethod
    def share(size: int, preferences: int) -> int:
        """Elements for each of so many preferences."""
        return max(4, min(size // preferences, size // 3))

    def _forget(self) -> None:
        self._value = torch.full_like(self.preferences, -math.inf)
        self._best: Tensor | None = None
        self._objectives = self.preferences.new_zeros(len(self.preferences), 2)

    def state_dict(self) -> dict[str, Any]:
        """The best for each preference too."""
        best = None if self._best is None else self._best.clone()
        found = {"value": self._value.clone(), "best": best, "objectives": self._objectives.clone()}
        return {**super().state_dict(), **found}

    def load_state_dict(self, state: dict[str, Any], climb: LBFGS) -> None:
        """The best for each preference too."""
        super().load_state_dict(state, climb)
        self._value, self._best, self._objectives = state["value"], state["best"], state["objectives"]

    def origins(self) -> tuple[Tensor, Tensor]:
        """Of each preference a quarter random, the others from Lloyd and OLS by turns."""
        place = torch.arange(self._each, device=self.preferences.device)
        kind = torch.where(place % 4 == 3, RANDOM, place % 2).repeat(len(self.preferences))
        return kind, (place.to(self.preferences) / self._each).repeat(len(self.preferences))

    def take(self, points: Tensor, objectives: Tensor) -> None:
        """Keep the best for each preference."""
        value, index = preferred(self.preferences[:, None], objectives).max(1)
        better = value > self._value
        best = points[index] if self._best is None else self._best
        self._value = torch.where(better, value, self._value)
        self._best = torch.where(better[:, None], points[index], best)
        self._objectives = torch.where(better[:, None], objectives[index], self._objectives)

    def rescore(self, score: Callable[[Tensor], Tensor]) -> None:
        """The best for each preference, and where the elements stand."""
        self.standing = score(self.points)
        if self._best is not None:
            self._objectives = score(self._best)
            self._value = preferred(self.preferences[:, None], self._objectives).diagonal().clone()

    def redeploy(self, climb: LBFGS, last: bool) -> LBFGS:
        """Replace the worse half; in the last round only the best quarter of each preference climbs."""
        if self._best is None:
            return climb
        value = preferred(self.preferences[:, None], self.standing)  # [preferences, elements]
        own = torch.arange(self.size, device=value.device).view(len(self.preferences), self._each)
        order = own.gather(1, value.gather(1, own).argsort(dim=1, descending=True, stable=True))
        if last:
            keep = self._each // 4
            # The best that was met comes instead of the best that stands, which it nearly always is.
            points = torch.cat((self._best[:, None], climb.points[order[:, 1:keep]]), 1).flatten(0, 1)
            self.aim = Preference(self.preferences.repeat_interleave(keep))
            self.standing = self.standing[:0]
            self._forget()
            return climb.anew(points)
        worse = order[:, (self._each + 1) // 2 :]
        noise = torch.randn(
            *worse.shape, climb.points.shape[1], generator=self._generator, dtype=value.dtype,
            device=self._generator.device,
        )  # fmt: skip
        points = (self._best[:, None] + HOP * noise.to(value.device)).clamp(0.0, 1.0)
        if len(self.preferences) > 1:
            value.scatter_(1, own, -math.inf)
            guests = value.topk(min(worse.shape[1], self.size - self._each), dim=1).indices[:, ::2]
            points[:, : guests.shape[1]] = climb.points[guests]
        climb.restart(worse.flatten(), points.flatten(0, 1))
        return climb

    def found(self) -> tuple[Tensor, Tensor, Tensor]:
        """One setup per preference."""
        best = self.points[:0] if self._best is None else self._best
        return best, self._objectives[: len(best)], self.preferences[: len(best)]

    def progress(self) -> list[tuple[float, Tensor]]:
        """One line per preference."""
        rows = zip(self.preferences.tolist(), self._objectives, strict=True)
        return [] if self._best is None else [(preference, row[None]) for preference, row in rows]
