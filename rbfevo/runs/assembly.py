"""The parts of one run, put together from its settings: scenario, kernel, representation, evaluators, methods."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import torch
from torch import Tensor

from rbfevo import methods
from rbfevo.errors import UserError
from rbfevo.methods.method import Heuristic, Method, Problem, Rows, no_preference, random_stream
from rbfevo.runs.config import OWN_CENTERS, Settings, brings_centers, build
from rbfevo.runs.identity import stages_of
from rbfevo.runs.judged import Judged
from rbfevo.scenarios.beginnings import read_kept, read_starts
from rbfevo.scenarios.coarse import coarsened, matched
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.bounded import BoundedPotential, bounded_of
from rbfevo.scoring.bounded_evaluator import BoundedEvaluator
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.evolvability import Scores
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.representations import Representation, Space, keeping
from rbfevo.scoring.symmetric import evaluator_of

# Up to this many numbers in U the rows of a result are scored by the definition, above by the blocked evaluator.
DEFINED_UP_TO = 4_000_000
MATCHED_ON = 20  # setups
# Below this many evaluations times vertices, plain torch is done before numba has compiled for the first time (8 s).
COMPILE_FROM = 10_000_000


class Parts:
    """What one run works with, before it has done anything.

    Args:
        settings: checked settings.
        backend: what the evaluators run on, as in `Evaluator`; None chooses by the size of the run.
        scenario: the design, where it is there already; None makes the one of the settings.

    Attributes:
        searched: the scenario that the search looks at: with `scenario.search_vertices` a coarse one.
        planned: evaluations that the methods plan.

    Raises:
        UserError: for what only shows when the parts meet (no such device, more centers than vertices, ...).
    """

    def __init__(self, settings: Settings, backend: str | None = None, scenario: Scenario | None = None) -> None:
        self.settings = settings
        self.device = chosen_device(settings.device)
        self.scenario: Scenario = build(settings.scenario) if scenario is None else scenario
        method = build(settings.method)
        self.stages = stages_of(method)
        self.settings = settings = self._counted(settings)
        self.kept = self._kept(settings)
        n, d = self.scenario.vertices.shape
        if settings.centers > n:
            raise UserError(
                f"centers={settings.centers}: scenario {self.scenario.name} has only {n} vertices; use fewer"
            )
        self.kernel: Kernel = build(settings.kernel, d, self.scenario.support, self.scenario.diagonal)
        made: Representation = build(settings.representation, self.scenario, self.kernel, settings.centers)
        self.representation = made.for_run(self.scenario, settings.manipulation)
        self.scenario = dataclasses.replace(self.scenario, notes={**self.scenario.notes, **self.representation.notes()})
        for stage in (stage for stage in self.stages if not isinstance(stage, Heuristic)):
            self.representation.refuse_search(stage.name)
        self.space = self._space()
        if settings.centers == OWN_CENTERS:
            own = self.representation.parameters(self.space.place(self.space.lower))
            self.settings = settings = dataclasses.replace(settings, centers=own)
        self._refuse_too_few_vertices(method)
        self.name: str = method.name
        for stage in self.stages:
            stage.check(settings.preferences)
        self.planned = sum(stage.planned_evaluations(settings.preferences) for stage in self.stages)
        self.searched = self.scenario
        self._backend = self._chosen_backend() if backend is None else backend
        self.full_evaluator = self.evaluator = self._evaluator(self.scenario)
        self.coarse_evaluators: list[Evaluator] = []

    def _counted(self, settings: Settings) -> Settings:
        """The settings with the number of centers that a method brings, whose notes join the scenario's.

        Raises:
            UserError: if another number was asked for.
        """
        own = brings_centers(settings.representation)
        for stage in (stage for stage in self.stages if stage.brings and not own):
            count, notes = stage.bring(self.scenario)
            if settings.centers not in (OWN_CENTERS, count):
                raise UserError(
                    f"centers={settings.centers}: the setups of method={stage.name} have {count} centers; leave "
                    f"centers= out, or set centers={count}"
                )
            settings = dataclasses.replace(settings, centers=count)
            self.scenario = dataclasses.replace(self.scenario, notes={**self.scenario.notes, **notes})
        return settings

    def _kept(self, settings: Settings) -> Tensor:
        """The centers [k, d] that every setup begins with; they and the starts of searches are read here.

        Raises:
            UserError: if a file cannot be used, or the method brings all centers itself.
        """
        kept, scenario = self.scenario.vertices.new_empty(0, self.scenario.vertices.shape[1]), self.scenario
        notes: dict[str, str] = {}
        if settings.keep is not None:
            for stage in (stage for stage in self.stages if stage.brings):
                raise UserError(f"keep={settings.keep}: method={stage.name} brings all centers itself; leave it out")
            kept, notes = read_kept(settings.keep, scenario, settings.centers)
            if scenario.mirror is not None:  # of an odd number of centers one is on the plane
                pinned = settings.centers % 2 == 1 and not bool(scenario.mirror.on_plane(kept).any())
                scenario = dataclasses.replace(scenario, pinned=pinned)
        for stage in (stage for stage in self.stages if stage.begins):
            stage.inputs, found = read_starts(stage.begins, scenario, kept, settings.centers)
            notes |= found
        self.scenario = dataclasses.replace(scenario, notes={**scenario.notes, **notes})
        return kept

    def _space(self) -> Space:
        """Where setups are searched, beside the centers that stay.

        Raises:
            UserError: if there are such centers, or starts, and the representation does not consist of centers.
        """
        asked = [stage.inputs for stage in self.stages if stage.begins and stage.inputs is not None]
        if len(self.kept) or asked:
            setup = self.kept if len(self.kept) else asked[0][0]
            if self.representation.assemble(setup) is None:
                key = "keep" if len(self.kept) else "method.start"
                raise UserError(f"{key} is for centers, and representation={self.representation.name} has none")
        space = self.representation.space(self.scenario, self.settings.centers - len(self.kept))
        return keeping(self.kept, space) if len(self.kept) else space

    def _chosen_backend(self) -> str:
        n = len(self.scenario.vertices)
        small = self.planned * min(n, self.scenario.search_vertices or n) < COMPILE_FROM
        return "eager" if self.settings.evaluator == "auto" and small else self.settings.evaluator

    def _refuse_too_few_vertices(self, method: Any) -> None:
        """Raise UserError if a search would look at fewer vertices than twice the centers."""
        asked = {
            "scenario.search_vertices": self.scenario.search_vertices,
            "method.coarse": getattr(method, "coarse", None),
        }
        for key, count in asked.items():
            if count is not None and count < len(self.scenario.vertices) and count < 2 * self.settings.centers:
                raise UserError(f"{key}={count}: give at least twice centers={self.settings.centers}")

    def _evaluator(self, scenario: Scenario) -> Evaluator:
        """Of this run's kernel, manipulation and criterion, on a scenario's vertices; a GPU does no more than that."""
        plain = evaluator_of(scenario.to(self.device), self.representation, self.settings.manipulation, self._backend)
        return plain if self.norm == 2.0 else BoundedEvaluator(plain, self.bounded(scenario))

    def bounded(self, scenario: Scenario) -> list[BoundedPotential]:
        """P_p of this run's setups on a scenario's vertices, of each objective."""
        return [bounded_of(alone, self.representation, self.norm, alone.mirror) for alone in scenario.each()]

    @property
    def norm(self) -> float:
        """`criterion.norm`."""
        return self.settings.criterion_norm

    def initial(self) -> Rows:
        """Draw the largest initial population that a method asks for, and score it on all vertices."""
        centers = self.space.place(
            self.space.sample(max(stage.initial for stage in self.stages), self._stream("initial"))
        )
        return no_preference("random", centers, self.full_evaluator(centers))

    @functools.cached_property
    def _for_matching(self) -> Rows:
        """A few random setups, scored on all vertices, where a method asks for no initial population."""
        centers = self.space.place(self.space.sample(MATCHED_ON, self._stream("matching")))
        return no_preference("random", centers, self.full_evaluator(centers))

    def _stream(self, name: str) -> torch.Generator:
        return random_stream(self.settings.seed, name)

    def problem(self, initial: Rows | None = None) -> Problem:
        """What the methods are given; draws the initial population where there is none yet."""
        initial = self.initial() if initial is None else initial
        problem = self._problem(self.scenario, self.full_evaluator, initial)
        if self.scenario.search_vertices is not None and self.scenario.search_vertices < len(self.scenario.vertices):
            problem = problem.coarsened(self.scenario.search_vertices)
            self.evaluator = self.coarse_evaluators.pop()
            self.searched = problem.scenario
        return problem

    def _problem(self, scenario: Scenario, evaluator: Evaluator, initial: Rows) -> Problem:
        def fewer_vertices(count: int) -> Problem:
            """The same problem on at most `count` weighted vertices; P is matched on the initial population."""
            fewer = coarsened(scenario, count)
            if fewer is scenario:
                return problem
            if self.norm != 2.0:  # which does not depend on the size of g
                self.coarse_evaluators.append(coarse := self._evaluator(fewer))
                return self._problem(fewer, coarse, initial)
            trial = self._evaluator(fewer)
            known = initial if len(initial.centers) else self._for_matching
            if scenario.objectives is None:
                potential = trial(known.centers).improvement_potential
                fewer = matched(fewer, potential, known.scores.improvement_potential)
            else:
                fewer = matched(fewer, trial.of_each(known.centers)[1], self.full_evaluator.of_each(known.centers)[1])
            coarse = self._evaluator(fewer)
            coarse.evaluations = trial.evaluations
            self.coarse_evaluators.append(coarse)
            return self._problem(fewer, coarse, initial)

        problem = Problem(
            evaluate=evaluator,
            space=self.space,
            centers=self.settings.centers,
            stream=self._stream,
            preferences=self.settings.preferences,
            initial=initial,
            scenario=scenario,
            representation=self.representation,
            spectrum=evaluator.spectrum,
            coarsened=fewer_vertices,
            norm=self.norm,
            kept=self.kept,
        )
        return problem

    @property
    def defined(self) -> bool:
        """Whether the rows of the result are scored by the definition."""
        return len(self.scenario.vertices) * self.settings.centers <= DEFINED_UP_TO

    def rescore(self, centers: torch.Tensor) -> Scores:
        """Scores on all vertices, by the definition where U is not too large for that."""
        return self.rescore_each(centers)[0]

    def rescore_each(self, centers: torch.Tensor) -> tuple[Scores, torch.Tensor]:
        """`rescore`, and P [p, J] of each objective; P itself is that of the whole gradient, the mean."""
        evaluator = self.full_evaluator
        if isinstance(evaluator, BoundedEvaluator):
            evaluator = evaluator.plain
        if self.defined:
            scores, potentials = evaluator.definition_of_each(centers)
        else:
            design = self.scenario.to(self.device), self.representation, self.settings.manipulation, evaluator.backend
            scores, potentials = evaluator_of(*design).of_each(centers)  # one of its own: no evaluations of the search
        mean = evaluator.combination.mean
        return scores._replace(improvement_potential=mean(potentials)), potentials

    def judged(self, rows: Rows) -> Judged:
        """Rows scored on all vertices, as they are saved and as they are searched."""
        if self.scenario.objectives is None:
            rows, potentials = rows._replace(scores=self.rescore(rows.centers)), None
        else:
            scores, potentials = self.rescore_each(rows.centers)
            rows = rows._replace(scores=scores)
        bounded = None
        if isinstance(self.full_evaluator, BoundedEvaluator):
            evaluator = BoundedEvaluator(self.full_evaluator.plain, self.bounded(self.scenario))
            found = evaluator.exact(rows.centers, self.defined)
            lost = rows.scores.failed | ~torch.isfinite(found).all(1)
            bounded = torch.where(lost[:, None], 0.0, found)
        return Judged(rows, potentials, bounded, self.full_evaluator.combination)


def unused_preferences(settings: Settings) -> list[str]:
    """A warning where preferences are asked for and none of the methods has any use for them."""
    stages = stages_of(build(settings.method))
    if settings.preferences is None or any(stage.prefers for stage in stages):
        return []
    every = [getattr(methods, name) for name in methods.__all__]
    others = sorted(other.name for other in every if issubclass(other, Method) and other.prefers)
    asked = [f"{preference:g}" for preference in settings.preferences]
    value = asked[0] if len(asked) == 1 else f"[{','.join(asked)}]"
    return [
        f"preference={value}: method={stages[0].name} finds the same setups without it; leave it out, or choose method="
        f"{' or '.join(others)}"
    ]


def chosen_device(name: str) -> torch.device:
    """The device that `device=` asks for.

    Raises:
        UserError: if it asks for CUDA and there is none.
    """
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("device=cuda: torch sees no CUDA device here; use device=cpu or device=auto")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
