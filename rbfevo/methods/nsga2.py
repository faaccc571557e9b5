"""NSGA-II: elitist search by nondominated sorting and crowding (Deb, Pratap, Agarwal and Meyarivan 2002)."""

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.method import Method, Problem, Rows, at_least_one, no_preference, starts_of, unscored
from rbfevo.scoring.pareto import best

Array = NDArray[np.floating[Any]]


class NSGA2:
    """NSGA-II on a box, by ask and tell: every objective is maximized, a row with a NaN is worse than all others.

    All random numbers come from `generator`, drawn on its device. What is asked for and kept lives where `initial`
    does; the work in between is NumPy's, on the host: an operation on so few numbers is over before a GPU has begun it.

    Args:
        initial: [N, D], inside the box; N even and at least 4.
        lower, upper: [D], the box.
        generator: source of all randomness.
        crossover_probability: of a pair of parents; each variable of such a pair then crosses with probability 0.5.
        crossover_eta: distribution index of the crossover; the larger, the nearer children are to their parents.
        mutation_probability: of each variable; None is 1/D.
        mutation_eta: distribution index of the mutation.

    Attributes:
        population: [N, D], the survivors, best first by (rank, crowding), ties in random order.
        objectives: [N, M], theirs; [N, 0] before the first `tell`.
        generation: number of populations evaluated so far, the initial one included.

    Raises:
        UserError: a population that is odd, too small or outside the box; a setting out of range.
    """

    def __init__(
        self,
        initial: Tensor,
        lower: Tensor,
        upper: Tensor,
        *,
        generator: torch.Generator,
        crossover_probability: float = 0.9,
        crossover_eta: float = 20.0,
        mutation_probability: float | None = None,
        mutation_eta: float = 20.0,
    ):
        N, D = initial.shape
        if mutation_probability is None:
            mutation_probability = 1.0 / D
        check_settings(N, crossover_probability, crossover_eta, mutation_probability, mutation_eta)
        self.lower = lower.detach().to(initial)
        self.upper = upper.detach().to(initial)
        if not bool((self.lower.isfinite() & self.upper.isfinite()).all()):
            raise UserError("NSGA-II: the box is not finite, give every variable a lower and an upper bound")
        if not bool(((initial >= self.lower) & (initial <= self.upper)).all()):
            raise UserError("NSGA-II: the initial population is not inside the box, move it between lower and upper")
        # Of the individuals laid end to end.
        self._box = self.lower.repeat(N).cpu().numpy(), self.upper.repeat(N).cpu().numpy()
        self.generator = generator
        self.crossover_probability = crossover_probability
        self.crossover_eta = crossover_eta
        self.mutation_probability = mutation_probability
        self.mutation_eta = mutation_eta
        self.population = initial.detach().clone()
        self.objectives = self.population.new_empty(N, 0)
        self.generation = 0
        self._asked: Tensor | None = None

    def ask(self) -> Tensor:
        """The individuals to score next: [N, D], inside the box; first the initial population, then offspring.

        Asking again before `tell` returns the same individuals.
        """
        asked = self._asked
        if asked is None:
            asked = self._offspring() if self.generation else self.population
            self._asked = asked
        return asked

    def tell(self, objectives: Tensor) -> None:
        """Take the objectives [N, M] (maximized) of the individuals last asked for, and keep the best N of all.

        Raises:
            UserError: nothing was asked for, or the shape does not fit.
        """
        if self._asked is None:
            raise UserError("NSGA-II: tell() called before ask(): call ask() and score its individuals")
        N, M = len(self.population), self.objectives.shape[1]
        if objectives.ndim != 2 or len(objectives) != N or objectives.shape[1] != (M or max(objectives.shape[1], 1)):
            raise UserError(
                f"NSGA-II: objectives of shape {list(objectives.shape)} do not fit; give [{N}, {M or 'M'}], a row each"
            )
        individuals, objectives = self._asked, objectives.detach().to(self.population)
        if self.generation:
            individuals = torch.cat([self.population, individuals])
            objectives = torch.cat([self.objectives, objectives])
        # Shuffled first: the stable sorts below then break every tie at random.
        shuffle = torch.randperm(len(objectives), generator=self.generator, device=self.generator.device)
        shuffle = shuffle.to(objectives.device)
        survivors = shuffle.take(best(objectives.index_select(0, shuffle), N))
        self.population = individuals.index_select(0, survivors)
        self.objectives = objectives.index_select(0, survivors)
        self.generation += 1
        self._asked = None

    def _offspring(self) -> Tensor:
        N, D = self.population.shape
        draws = torch.rand(
            2 * N + N // 2 + N // 2 * D + N * D,
            dtype=self.population.dtype,
            generator=self.generator,
            device=self.generator.device,
        )
        parts = draws.cpu().split([2 * N, N // 2, N // 2 * D, N * D])
        lots, pairs, crossing, mutation = (part.numpy() for part in parts)
        with np.errstate(all="ignore"):
            # Binary tournament: everyone enters twice; the population is sorted, so the smaller index wins.
            lots = lots.reshape(2, N).argsort(axis=1, kind="stable").reshape(N // 2, 2, 2)
            winners = np.minimum(lots[:, :, 0], lots[:, :, 1])
            x = self.population.cpu().numpy()[winners.T].reshape(2, N // 2 * D)
            crossing = crossing.reshape(N // 2, D) + (pairs >= self.crossover_probability)[:, None]
            _crossover(x, *self._box, self.crossover_eta, crossing.reshape(-1))
            x = x.reshape(N * D)
            _mutate(x, *self._box, self.mutation_eta, self.mutation_probability, mutation)
            lower, upper = self._box
            np.minimum(np.maximum(x, lower, out=x), upper, out=x)  # against rounding
        return torch.from_numpy(x).view(N, D).to(self.population.device)

    def state_dict(self) -> dict[str, Any]:
        """All that changes from call to call, as tensors and numbers; the settings are those of the constructor."""
        return {
            "population": self.population.clone(),
            "objectives": self.objectives.clone(),
            "generation": self.generation,
            "asked": self.population[:0].clone() if self._asked is None else self._asked.clone(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a `state_dict()`, bit for bit.

        Raises:
            UserError: the state is of another population size or number of variables.
        """
        if state["population"].shape != self.population.shape:
            raise UserError(
                f"NSGA-II: the saved population is {list(state['population'].shape)}, "
                f"not {list(self.population.shape)}: resume with the settings of the run"
            )
        objectives, asked = state["objectives"].to(self.population), state["asked"].to(self.population)
        self.population = state["population"].to(self.population).clone()
        self.objectives = objectives.clone()
        self.generation = int(state["generation"])
        self._asked = asked.clone() if len(asked) else None
        self.generator.set_state(state["generator"].cpu())


def check_settings(
    population: int,
    crossover_probability: float,
    crossover_eta: float,
    mutation_probability: float | None,
    mutation_eta: float,
) -> None:
    """Refuse settings that NSGA-II cannot work with.

    Raises:
        UserError: naming the setting, its value, and what it may be.
    """
    if population < 4 or population % 2:
        raise UserError(f"nsga2: population={population}: choose an even population of at least 4")
    probabilities = {"crossover_probability": crossover_probability, "mutation_probability": mutation_probability}
    for name, value in probabilities.items():
        if value is not None and not 0.0 <= value <= 1.0:
            raise UserError(f"nsga2: {name}={value}: choose a number from 0 to 1")
    for name, value in (("crossover_eta", crossover_eta), ("mutation_eta", mutation_eta)):
        if not 0.0 <= value < math.inf:
            raise UserError(f"nsga2: {name}={value}: choose a number that is 0 or larger")


def _power(x: Array, exponent: float) -> Array:
    torch.from_numpy(x).pow_(exponent)  # NumPy's differs in the last bit, and a saved search has to go on as it began
    return x


def _crossover(parents: Array, lower: Array, upper: Array, eta: float, choice: Array) -> None:
    """Bounded simulated binary crossover of parents [2, n] (Deb and Agrawal 1995; bounds as in Deb's own code).

    They become their children. A variable crosses where its uniform `choice` [n] is below 1/2. Its first two binary
    digits are then spent (on the crossing, and on which child gets which value); the others are a uniform number again,
    u of the spread factor.
    """
    crossed = (choice < 0.5).nonzero()[0]
    one, other = parents[0].take(crossed), parents[1].take(crossed)
    low, high = np.minimum(one, other), np.maximum(one, other)
    distance = high - low
    room = np.stack((low - lower.take(crossed), upper.take(crossed) - high))
    choice = choice.take(crossed) * 4.0
    # 1/beta for the largest spread factor beta that stays in the box, on either side; 0 where the parents agree.
    room *= 2.0
    room += distance
    tightest = distance / np.maximum(room, np.finfo(room.dtype).tiny, out=room)
    t = (choice - np.trunc(choice)) * (2.0 - _power(tightest, eta + 1.0))  # alpha u, with alpha = 2 - beta^-(eta + 1)
    # beta_q = (alpha u)^(1/(eta + 1)) where alpha u <= 1, else (1 / (2 - alpha u))^(1/(eta + 1)).
    beta = _power(np.where(t <= 1.0, t, 1.0 / (2.0 - t)), 1.0 / (eta + 1.0))
    half, middle = beta * (0.5 * distance), 0.5 * (low + high)
    below, above = middle - half[0], middle + half[1]
    first = choice < 1.0
    parents[0][crossed] = np.where(first, below, above)
    parents[1][crossed] = np.where(first, above, below)


def _mutate(x: Array, lower: Array, upper: Array, eta: float, probability: float, choice: Array) -> None:
    """Bounded polynomial mutation of x [n], in place (Deb and Goyal 1996; bounds as in Deb's own code).

    A variable mutates where its uniform `choice` [n] is below `probability`; choice / probability is then uniform again
    and sets how far.
    """
    mutated = (choice < probability).nonzero()[0]
    tiny = float(np.finfo(x.dtype).tiny)
    y, low = x.take(mutated), lower.take(mutated)
    width = upper.take(mutated) - low
    place = np.minimum(np.maximum((y - low) / np.maximum(width, tiny), 0.0), 1.0)
    # u below 1/2 goes down, above goes up; v = 1 - |2u - 1|; far is how much of the box lies on the other side.
    up = choice.take(mutated) * (2.0 / max(probability, tiny)) - 1.0
    v = 1.0 - np.abs(up)
    far = np.where(up > 0.0, place, 1.0 - place)
    step = 1.0 - _power(v + (1.0 - v) * _power(far, eta + 1.0), 1.0 / (eta + 1.0))
    x[mutated] = y + np.copysign(step, up) * width


class Nsga2Search(Method):
    """The front of regularity and improvement potential by NSGA-II (paper, section 5).

    The setups in the files of `start` take the places of as many random ones in the first population.
    """

    name = "nsga2"

    def __init__(
        self,
        population: int = 100,
        generations: int = 1000,
        crossover_probability: float = 0.9,
        crossover_eta: float = 20.0,
        mutation_probability: float | None = None,
        mutation_eta: float = 20.0,
        start: Any = None,
    ) -> None:
        self.steps = at_least_one(f"{self.name}: generations", generations)
        check_settings(population, crossover_probability, crossover_eta, mutation_probability, mutation_eta)
        self.initial = self.population = population
        self.crossover_probability, self.crossover_eta = crossover_probability, crossover_eta
        self.mutation_probability, self.mutation_eta = mutation_probability, mutation_eta
        self.begins = starts_of(start, self.name, population)

    def planned_evaluations(self, preferences: tuple[float, ...] | None) -> int:
        return self.steps * self.population + len(self.begins)

    def start(self, problem: Problem) -> None:
        lower, upper = problem.flat_box
        self._problem = problem
        start, objectives = problem.initial.centers[: self.population], problem.initial.scores.objectives
        objectives = objectives[: self.population]
        if self.inputs is not None:
            given = problem.space.place(self.inputs.to(start))
            start = torch.cat((given, start[len(given) :]))
            objectives = torch.cat((problem.evaluate(given).objectives, objectives[len(given) :]))
        self.algorithm = NSGA2(
            problem.flatten(start),
            lower,
            upper,
            generator=problem.stream("nsga2"),
            crossover_probability=self.crossover_probability,
            crossover_eta=self.crossover_eta,
            mutation_probability=self.mutation_probability,
            mutation_eta=self.mutation_eta,
        )
        self.algorithm.ask()
        self.algorithm.tell(objectives)

    def step(self) -> None:
        centers = self._problem.unflatten(self.algorithm.ask())
        self.algorithm.tell(self._problem.evaluate(centers).objectives)

    def progress(self) -> list[tuple[float, Tensor]]:
        return [(math.nan, self.algorithm.objectives)]

    def rows(self) -> list[Rows]:
        centers = self._problem.unflatten(self.algorithm.population)
        return [no_preference(self.name, centers, unscored(centers, self.algorithm.objectives))]

    def state_dict(self) -> dict[str, Any]:
        """The population, its objectives and the generator."""
        return self.algorithm.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue with that population."""
        self.algorithm.load_state_dict(state)

    def fits(self, steps: int) -> bool:
        """A generation does not know how many there will be."""
        return True
