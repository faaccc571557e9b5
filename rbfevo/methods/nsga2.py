"""NSGA-II: elitist search by nondominated sorting and crowding (Deb, Pratap, Agarwal and Meyarivan 2002)."""

import math
from typing import Any

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.pareto import crowding, ranks


class NSGA2:
    """NSGA-II on a box, by ask and tell: every objective is maximized, a row with a NaN is worse than all others.

    All random numbers come from `generator`, drawn on its device; everything else runs where `initial` lives.

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
        generation: number of populations told so far, the initial one included.

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
        self._lower, self._upper = self.lower.repeat(N), self.upper.repeat(N)  # of the individuals laid end to end
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
            raise UserError("NSGA-II: tell came before ask, ask for individuals and score those")
        N, M = len(self.population), self.objectives.shape[1]
        if objectives.ndim != 2 or len(objectives) != N or objectives.shape[1] != (M or max(objectives.shape[1], 1)):
            raise UserError(
                f"NSGA-II: objectives of shape {list(objectives.shape)} do not fit, tell [{N}, {M or 'M'}]: a row each"
            )
        individuals, objectives = self._asked, objectives.detach().to(self.population)
        if self.generation:
            individuals = torch.cat([self.population, individuals])
            objectives = torch.cat([self.objectives, objectives])
        # Shuffled first: the stable sorts below then break every tie at random.
        shuffle = torch.randperm(len(objectives), generator=self.generator, device=self.generator.device)
        shuffle = shuffle.to(objectives.device)
        survivors = shuffle.take(_best(objectives.index_select(0, shuffle), N))
        self.population = individuals.index_select(0, survivors)
        self.objectives = objectives.index_select(0, survivors)
        self.generation += 1
        self._asked = None

    def _offspring(self) -> Tensor:
        N, D = self.population.shape
        where = self.generator.device
        draws = torch.rand(
            2 * N + N // 2 + N // 2 * D + N * D, dtype=self.population.dtype, generator=self.generator, device=where
        )
        draws = draws.to(self.population.device)
        lots, pairs, crossing, mutation = draws.split([2 * N, N // 2, N // 2 * D, N * D])
        # Binary tournament: everyone enters twice; the population is sorted, so the smaller index wins.
        winners = lots.view(2, N).argsort(dim=1).view(N // 2, 2, 2).amin(dim=2)
        parents = self.population.index_select(0, winners.T.reshape(-1)).view(2, N // 2 * D)
        crossing = (crossing.view(N // 2, D) + (pairs >= self.crossover_probability)[:, None]).view(-1)
        children = _crossover(parents, self._lower, self._upper, self.crossover_eta, crossing)
        children = _mutate(
            children.view(-1), self._lower, self._upper, self.mutation_eta, self.mutation_probability, mutation
        )
        return children.view(N, D).clamp(self.lower, self.upper)  # against rounding

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


def _best(objectives: Tensor, N: int) -> Tensor:
    """Indices of the N best rows by (rank, crowding), best first, ties by row."""
    rank = ranks(objectives, enough=N)
    order = crowding(objectives, rank).argsort(descending=True, stable=True)
    return order.take(rank.take(order).argsort(stable=True)[:N])


def _crossover(parents: Tensor, lower: Tensor, upper: Tensor, eta: float, choice: Tensor) -> Tensor:
    """Bounded simulated binary crossover of parents [2, n] (Deb and Agrawal 1995; bounds as in Deb's own code).

    A variable crosses where its uniform `choice` [n] is below 1/2. Its first two binary digits are then spent (they
    said to cross, and which child gets which value); the others are a uniform number again, u of the spread factor.
    """
    crossed = (choice < 0.5).nonzero().squeeze(1)
    pairs = parents.index_select(1, crossed)
    low, high = torch.minimum(*pairs), torch.maximum(*pairs)
    distance = high - low
    room = torch.stack([low - lower.index_select(0, crossed), upper.index_select(0, crossed) - high])
    choice = choice.index_select(0, crossed).mul_(4.0)
    # 1/beta for the largest spread factor beta that stays in the box, on either side; 0 where the parents agree.
    tightest = distance / room.mul_(2.0).add_(distance).clamp_min_(torch.finfo(choice.dtype).tiny)
    t = choice.frac() * (2.0 - tightest.pow_(eta + 1.0))  # alpha u, with alpha = 2 - beta^-(eta + 1)
    # beta_q = (alpha u)^(1/(eta + 1)) where alpha u <= 1, else (1 / (2 - alpha u))^(1/(eta + 1)).
    beta = torch.where(t <= 1.0, t, 1.0 / (2.0 - t)).pow_(1.0 / (eta + 1.0))
    half, middle = beta.mul_(0.5 * distance), 0.5 * (low + high)
    below, above = middle - half[0], middle + half[1]
    first = choice < 1.0
    children = torch.stack([torch.where(first, below, above), torch.where(first, above, below)])
    return parents.index_copy(1, crossed, children)


def _mutate(x: Tensor, lower: Tensor, upper: Tensor, eta: float, probability: float, choice: Tensor) -> Tensor:
    """Bounded polynomial mutation of x [n] (Deb and Goyal 1996; bounds as in Deb's own code).

    A variable mutates where its uniform `choice` [n] is below `probability`; choice / probability is then uniform again
    and says how far.
    """
    mutated = (choice < probability).nonzero().squeeze(1)
    y, low = x.index_select(0, mutated), lower.index_select(0, mutated)
    width = upper.index_select(0, mutated) - low
    place = ((y - low) / width.clamp_min(torch.finfo(x.dtype).tiny)).clamp_(0.0, 1.0)
    # u below 1/2 goes down, above goes up; v = 1 - |2u - 1|; far is how much of the box lies on the other side.
    up = choice.index_select(0, mutated).mul_(2.0 / max(probability, torch.finfo(x.dtype).tiny)).sub_(1.0)
    v = 1.0 - up.abs()
    far = torch.where(up > 0.0, place, 1.0 - place)
    step = 1.0 - (v + (1.0 - v) * far.pow(eta + 1.0)).pow(1.0 / (eta + 1.0))
    return x.index_copy(0, mutated, y + step.copysign(up) * width)
