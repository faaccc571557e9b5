"""The whole front, or one setup per preference, by gradients: one batch of quasi-Newton climbs from many starts."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.gradient.lbfgs import LBFGS
from rbfevo.methods.gradient.rise import rise
from rbfevo.methods.gradient.teams import RANDOM, FrontTeam, Team, WishTeam
from rbfevo.methods.lloyd import LloydHeuristic
from rbfevo.methods.method import Method, Problem, Rows, at_least_one, starts_of, unscored
from rbfevo.methods.ols import OlsHeuristic

ROUNDS = 5
FIRST_ROUND = 0.18  # of the generations: starts climb on their own before the front is looked at
REFRESH = 10  # generations of the first round after which the smoothing is fitted to what R has become
SHARPNESS = 8.0  # of the smooth R and the smooth least P in the first round; doubled in every later one
SCATTER = 0.1  # of the box: standard deviation of the most scattered copy of a heuristic setup


class GradientSearch(Method):
    """The front of regularity and improvement potential, or with preferences one setup for each (paper, eq. 9).

    A generation is one value and gradient of `population` setups: `generations` of them on a design of about `coarse`
    weighted vertices, then `polish` on all vertices. Starts are copies of the Lloyd and the OLS setup, scattered, and
    random setups, which climb on a design of about `rough` vertices. After each of five rounds the setups are put where
    the front found so far has most to gain, but for two teams that go on for R and for P alone.

    Args:
        starts: setups that climb in the first round; not used for preferences.
        population: setups that climb in later rounds, at least 16 and at most `starts`; for preferences in all of them.
        generations: on the coarse design.
        polish: generations on all vertices.
        front: setups of the front that are returned; at least 2.
        coarse: vertices of the coarse design, about; at least 100.
        rough: vertices of the design of the first round, about; at least 100 and at most `coarse`.
        memory: pairs that the quasi-Newton method keeps of each setup.
        start: files with setups to start from: they, and scattered copies of them, take the places of every second
            random setup. They are candidates for the result as they are, too.
    """

    name = "gradient"
    prefers = True

    def __init__(
        self,
        starts: int = 320,
        population: int = 48,
        generations: int = 280,
        polish: int = 15,
        front: int = 100,
        coarse: int = 2000,
        rough: int = 800,
        memory: int = 40,
        start: Any = None,
    ) -> None:
        least = {"population": (population, 16), "front": (front, 2), "coarse": (coarse, 100)}
        least["rough"] = (rough, 100)
        for name, (value, smallest) in least.items():
            if value < smallest:
                raise UserError(f"gradient: {name}={value}: at least {smallest} is needed")
        self.generations = at_least_one("gradient: generations", generations)
        self.polish = at_least_one("gradient: polish", polish)
        self.memory = at_least_one("gradient: memory", memory)
        self.steps = self.generations + self.polish
        self.starts = at_least_one("gradient: starts", starts)
        self.population = population
        self.initial = max(starts // 2, population)  # random setups: no more than half of the starts are random
        self.front, self.coarse, self.rough = front, coarse, min(rough, coarse)
        self.begins = starts_of(start, self.name, population // 8)
        first = max(1, round(FIRST_ROUND * self.generations))
        later = (self.generations - first) / (ROUNDS - 1)
        self._ends = sorted({first + round(i * later) for i in range(ROUNDS)})

    def check(self, preferences: tuple[float, ...] | None) -> None:
        if preferences is None and self.starts < self.population:
            raise UserError(f"gradient: starts={self.starts}: at least population={self.population} is needed")

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        if preferences is None:
            climbs = self._ends[0] * self.starts + (self.steps - self._ends[0]) * self.population
            return climbs + len(self.begins)
        each = WishTeam.share(self.population, len(preferences))
        return len(preferences) * (self.generations * each + self.polish * (each // 4)) + len(self.begins)

    def start(self, problem: Problem) -> None:
        self.check(problem.preferences)
        self._fine, self._coarse = problem, problem.coarsened(self.coarse)
        self._problem = self._coarse if self.rough == self.coarse else problem.coarsened(self.rough)
        self._side = problem.space.upper - problem.space.lower
        self._step, self._sharpness, self._renew = 0, SHARPNESS, True
        self._exponents: Tensor | None = None
        self._near: Tensor | None = None
        like = problem.initial.centers
        self._generator = problem.stream(self.name)
        if problem.preferences is None:
            self._team: Team = FrontTeam(self.starts, self.population, self.front, like)
        else:
            wishes = torch.tensor(problem.preferences, dtype=like.dtype, device=like.device)
            self._team = WishTeam(self.population, wishes, self._generator)
        self._climb = LBFGS(self._starts(), self.memory)

    def _starts(self) -> Tensor:
        """[size, D] in the unit box: what each element of the team wants, scattered or random."""
        problem = self._problem
        space, random = problem.space, problem.space.points(problem.initial.centers)
        kind, scatter = self._team.origins()
        random = random[torch.arange(len(kind), device=random.device) % len(random)]
        known = self._heuristics(problem)
        if known is None:
            return ((random - space.lower) / self._side).flatten(1).clamp(0.0, 1.0)
        known = space.points(known)
        where = self._generator.device
        noise = torch.randn(len(kind), *known.shape[1:], generator=self._generator, dtype=known.dtype, device=where)
        each = (-1, *(1,) * (known.ndim - 1))
        base = known[kind.clamp_min(0)] + SCATTER * scatter.view(each) * self._side * noise.to(known.device)
        points = torch.where((kind == RANDOM).view(each), random, base)
        if self.inputs is not None:
            given = self.inputs.to(points)
            rows = (kind == RANDOM).nonzero().flatten()[::2]
            turn = torch.arange(len(rows), device=rows.device)
            scatter = torch.where(turn < len(given), 0.0, scatter[rows]).view(each)
            points[rows] = given[turn % len(given)] + SCATTER * scatter * self._side * noise.to(points)[rows]
        points = space.points(space.place(points))
        return ((points - space.lower) / self._side).flatten(1).clamp(0.0, 1.0)

    @staticmethod
    def _heuristics(problem: Problem) -> Tensor | None:
        """The setups [2, *setup] of Lloyd and OLS; None where setups do not consist of centers."""
        if problem.representation.atoms(problem.scenario.vertices) is None:
            return None
        lloyd = LloydHeuristic(starts=3, iterations=50).place(problem)[0]
        flat = problem.scenario.vertices.shape[1] == 2 or problem.scenario.planar is not None
        per_axis = 30 if flat else 15
        return torch.stack((lloyd, OlsHeuristic(per_axis=per_axis).place(problem)[0]))

    def step(self) -> None:
        if self._step in self._ends:
            last = self._step == self.generations
            if self._step == self._ends[0]:
                self._problem = self._coarse
                self._team.rescore(self._objectives)
            self._climb, self._near = self._team.redeploy(self._climb, last), None
            self._problem = self._fine if last else self._problem
            if last:
                self._take_given()
            self._sharpness *= 2.0
            self._renew = True
        if self._renew or (self._step < self._ends[0] and self._step % REFRESH == 0):
            self._climb.revalue()
            self._renew = True
        points = self._climb.ask()
        placed = self._placed(points)
        exponents = None if self._renew else self._exponents
        risen = rise(self._problem, placed, self._team.aim, self._sharpness, exponents, self._near, self._climb.accepts)
        self._exponents, self._near, self._renew = risen.exponents, risen.near, False
        self._climb.tell(risen.values, (risen.gradients * self._side).flatten(1))
        self._team.move(self._climb, points, risen.objectives, self._climb.accepted)
        self._step += 1

    def _take_given(self) -> None:
        """Score the setups of `start`, as they are, among what has been found on all vertices."""
        if self.inputs is not None:
            given = self.inputs.to(self._side)
            points = ((given - self._fine.space.lower) / self._side).flatten(1).clamp(0.0, 1.0)
            self._team.take(points, self._fine.evaluate(self._fine.space.place(given)).objectives)

    def state_dict(self) -> dict[str, Any]:
        """Elements, team, generator, and how sharp the smooth R and P are."""
        return {
            "step": self._step,
            "sharpness": self._sharpness,
            "renew": self._renew,
            "exponents": None if self._exponents is None else self._exponents.clone(),
            "climb": self._climb.state_dict(),
            "team": self._team.state_dict(),
            "generator": self._generator.get_state(),
            **({} if self._near is None else {"near": self._near.clone()}),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue with those elements."""
        self._step, self._sharpness, self._renew = int(state["step"]), float(state["sharpness"]), bool(state["renew"])
        self._exponents, self._near = state["exponents"], state.get("near")
        self._climb.load_state_dict(state["climb"])
        self._team.load_state_dict(state["team"], self._climb)
        self._generator.set_state(state["generator"].cpu())
        if self._step > self._ends[0]:
            self._problem = self._fine if self._step > self.generations else self._coarse

    def _objectives(self, points: Tensor) -> Tensor:
        """R and P [p, 2] of points [p, D] of the unit box."""
        return self._problem.evaluate(self._problem.space.place(self._placed(points))).objectives

    def _placed(self, points: Tensor) -> Tensor:
        """Points [p, D] of the unit box as points [p, *setup] of the box."""
        return self._problem.space.lower + self._side * points.unflatten(1, self._side.shape)

    def progress(self) -> list[tuple[float, Tensor]]:
        return self._team.progress()

    def rows(self) -> list[Rows]:
        points, objectives, preference = self._team.found()
        if not len(points):
            return []
        centers = self._problem.space.place(self._placed(points))
        return [Rows(self.name, centers, unscored(centers, objectives), preference)]
