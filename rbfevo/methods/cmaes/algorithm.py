"""A batch of independent (mu/mu_w, lambda)-CMA-ES with active covariance update, run as one tensor program.

Equation numbers are those of N. Hansen, *The CMA Evolution Strategy: A Tutorial*, arXiv:1604.00772. Three choices are
ours:

- y = C^(1/2) z with the symmetric root stands for eq. 39's B D z. The distribution is the same, C^(-1/2) y is z itself,
  and the root, unlike the eigenvectors, depends continuously on C: a batch and a loop over its elements stay together.
- Selection is of `parents` among `offspring`: eq. 49 with 2 parents in place of lambda weighs the best `parents` and
  the worst as many (pycma's rule for CMA_mu); the ranks between weigh 0. For parents = offspring / 2 it is eq. 49.
- The box is handled by a change of coordinates (`Box`), so that selection, paths and C never see a repaired point.

Without covariance (C = I for good, eq. 43 and 44 alone) it is the (mu/mu_w, lambda)-CSA-ES, an isotropic evolution
strategy that feels how badly conditioned its parameters are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.methods.cmaes.box import Box
from rbfevo.methods.cmaes.strategy import Strategy
from rbfevo.scoring.matrices import all_finite, eigh, product
from rbfevo.scoring.threads import coarse

CONDITION_LIMIT = 1e14  # of C
STEP_RANGE = (1e-100, 1e100)  # of sigma, so that neither underflow nor overflow makes a NaN
SCALE_RANGE = (1e-20, 1e20)  # of the largest eigenvalue of C; beyond it the scale moves into sigma
STALENESS = 0.02  # the share of C's memory, 1 / (c_1 + c_mu) generations, by which its root may lag behind


class CMAES:
    """B independent CMA-ES that MAXIMIZE, in a box, with shared settings and one random generator each.

    Everything is float64, on the device of `mean`. `ask` and `tell` alternate. Any bound may be infinite. An element
    whose offspring all tie (or are all NaN) keeps its distribution and samples it again: with a constant objective, or
    once converged, it stays where it is. An element whose C is not finite restarts from C = I at its mean. Along a side
    of the box no standard deviation exceeds max(1/3, sigma) of the side.

    Args:
        mean: [B, D] where to start, inside the box.
        sigma: first standard deviation, as a share of each side of the box (absolute where a bound is infinite).
        lower, upper: [D] bounds, in the unit of `mean`.
        generators: B generators; element b draws its [offspring, D] normals of a generation in one call from the b-th.
        parents, offspring: mu and lambda.
        covariance: whether C adapts; otherwise C = I, only the step size adapts, and a generation costs no more than
            its normals and sorting.

    Attributes:
        best: [B, D] the best point evaluated so far, the start until there is one.
        best_fitness: [B] its fitness, -inf until there is one.
        sigma: [B] step sizes, in the unit of the argument.
        generation: number of `tell`s.

    Raises:
        UserError: parents > offspring, parents < 1, offspring < 2, sigma <= 0, an empty box, a mean outside it, or
            shapes that do not fit.
    """

    def __init__(
        self,
        mean: Tensor,
        sigma: float,
        lower: Tensor,
        upper: Tensor,
        *,
        generators: Sequence[torch.Generator],
        parents: int = 25,
        offspring: int = 100,
        covariance: bool = True,
    ) -> None:
        mean, lower, upper = (t.detach().to(mean.device, torch.float64) for t in (mean, lower, upper))
        _check(mean, sigma, lower, upper, len(generators), parents, offspring)
        B, D = mean.shape
        self.strategy = s = Strategy.default(D, parents, offspring, covariance)
        self.box = Box(lower, upper, sigma)
        self.generation = 0
        self.best, self.best_fitness = mean.clone(), mean.new_full((B,), -math.inf)
        self.sigma = mean.new_full((B,), float(sigma))
        self._generators, self._offspring, self._start_sigma = list(generators), offspring, float(sigma)
        self._m = self.box.to_search(mean).clone()
        self._p_sigma = torch.zeros_like(mean)
        self._covariance = covariance
        self._state = ("_m", "sigma", "_p_sigma", "best", "best_fitness", "_z", "_x")
        if covariance:
            self._p_c = torch.zeros_like(mean)
            self._C = torch.eye(D, dtype=mean.dtype, device=mean.device).repeat(B, 1, 1)
            self._root = self._C.clone()
            self._state = ("_m", "sigma", "_C", "_root", "_p_sigma", "_p_c", "best", "best_fitness", "_z", "_x")
        self._z: Tensor | None = None
        self._x: Tensor | None = None
        self._positive, self._negative = mean.new_tensor(s.positive), mean.new_tensor(s.negative)
        weighed = [*range(parents), *range(offspring - len(s.negative), offspring)]
        self._weighed = torch.tensor(weighed, device=mean.device)
        self._widest = torch.where(self.box.closed, max(1 / 3, float(sigma)), torch.full_like(lower, math.inf))
        # The tutorial (B.2) waits 1 / (10 n (c_1 + c_mu)) generations to amortize n^3 flops. What bounds the wait is
        # that C must not change much meanwhile, so here it is a share of C's memory whatever n: at (25, 100) every
        # generation up to n = 49, every 2nd at 50, every 4th at 75. Ellipsoid and Rosenbrock there took at most 0.6%
        # more evaluations than when decomposing every generation (3% for a share of 0.05).
        self._wait = max(1, int(STALENESS / (s.c_1 + s.c_mu))) if covariance else 0

    @property
    def mean(self) -> Tensor:
        """[B, D] the means of the search distributions, as points of the box."""
        return self.box.to_box(self._m)

    @coarse()
    def ask(self) -> Tensor:
        """Draw the offspring of this generation: [B, lambda, D], inside the box (eq. 38-40).

        Asking again before `tell` returns the same offspring.
        """
        if self._x is not None:
            return self._x.clone()
        B, D = self._m.shape
        z = self._m.new_empty(B, self._offspring, D)
        for b, generator in enumerate(self._generators):
            if generator.device == z.device:
                z[b].normal_(generator=generator)  # eq. 38
            else:
                z[b] = torch.empty(z.shape[1:], dtype=z.dtype, device=generator.device).normal_(generator=generator)
        y = product(z, self._root) if self._covariance else z  # eq. 39
        self._z, self._x = z, self.box.to_box(self._m[:, None] + self.sigma[:, None, None] * y)  # eq. 40
        return self._x.clone()

    @coarse()
    def tell(self, fitness: Tensor) -> None:
        """Update every element from the fitness [B, lambda] of the last `ask`; maximized, NaN counts as worst.

        Ties keep the order of the offspring.

        Raises:
            UserError: without an `ask` before it, or for another shape.
        """
        if self._z is None or self._x is None:
            raise UserError("CMAES.tell() called before ask(): call ask() first")
        if fitness.shape != self._z.shape[:2]:
            expected, given = list(self._z.shape[:2]), list(fitness.shape)
            raise UserError(f"CMAES.tell: fitness must be [elements, offspring] = {expected}, not {given}")
        s = self.strategy
        f = fitness.detach().to(self._m)
        f = torch.where(f.isnan(), -math.inf, f)
        order = f.argsort(dim=1, descending=True, stable=True)
        self._keep_best(f, self._x, order[:, :1])

        z = self._z.take_along_dim(order[:, self._weighed, None], 1)  # the weighed offspring, best to worst
        y = product(z, self._root) if self._covariance else z
        mu = len(s.positive)
        positive = self._positive[:, None]
        y_w, z_w = ((positive * steps[:, :mu]).sum(1) for steps in (y, z))  # eq. 41; z_w = C^(-1/2) y_w
        m = self._m + self.sigma[:, None] * y_w  # eq. 42, c_m = 1 (eq. 54)
        gain = math.sqrt(s.c_sigma * (2 - s.c_sigma) * s.mu_eff)
        p_sigma = (1 - s.c_sigma) * self._p_sigma + gain * z_w  # eq. 43
        length = p_sigma.square().sum(1).sqrt()
        change = s.c_sigma / s.d_sigma * (length / s.chi - 1)
        sigma = (self.sigma * change.clamp(max=1).exp()).clamp(*STEP_RANGE)  # eq. 44, by no more than e at once

        informed = (f.amax(1) > f.amin(1))[:, None]  # else there is nothing to learn from
        if self._covariance:
            self._adapt(informed, y, y_w, z[:, mu:], length)
        self._m, self._p_sigma = torch.where(informed, m, self._m), torch.where(informed, p_sigma, self._p_sigma)
        self.sigma = torch.where(informed[:, 0], sigma, self.sigma)
        self._z = self._x = None
        self.generation += 1
        if not self._covariance:
            self.sigma = self.sigma.clamp(max=self._widest.amin())
        elif self.generation % self._wait == 0:
            self._decompose()

    def _adapt(self, informed: Tensor, y: Tensor, y_w: Tensor, worst: Tensor, length: Tensor) -> None:
        """Move C and its path of the elements that are `informed` [B, 1], by the weighed steps y [B, weighed, D].

        `worst` [B, negative, D] are the normals of those with negative weights, `length` [B] is |p_sigma|.
        """
        s, n, mu = self.strategy, y.shape[2], len(self.strategy.positive)
        unbiased = math.sqrt(1 - (1 - s.c_sigma) ** (2 * (self.generation + 1)))
        h = (length / unbiased < (1.4 + 2 / (n + 1)) * s.chi).to(y)[:, None]
        p_c = (1 - s.c_c) * self._p_c + h * math.sqrt(s.c_c * (2 - s.c_c) * s.mu_eff) * y_w  # eq. 45
        negative = self._negative * n / worst.square().sum(2).clamp(min=1e-300)  # eq. 46: |C^(-1/2) y|^2 = |z|^2
        w = torch.cat([self._positive.expand(len(y), mu), negative], 1)
        total = sum(s.positive) + sum(s.negative)
        delta = (1 - h) * s.c_c * (2 - s.c_c)
        keep = 1 + s.c_1 * delta - s.c_1 - s.c_mu * total
        rank_mu = product((w[..., None] * y).mT, y)
        C = keep[..., None] * self._C + s.c_1 * p_c[..., None] * p_c[:, None] + s.c_mu * rank_mu  # eq. 47
        self._p_c = torch.where(informed, p_c, self._p_c)
        self._C = torch.where(informed[..., None], C, self._C)

    def _keep_best(self, f: Tensor, x: Tensor, first: Tensor) -> None:
        top = f.take_along_dim(first, 1)[:, 0]
        better = top > self.best_fitness
        self.best = torch.where(better[:, None], x.take_along_dim(first[..., None], 1)[:, 0], self.best)
        self.best_fitness = torch.where(better, top, self.best_fitness)

    def _decompose(self) -> None:
        """Bring C^(1/2) up to date; keep C, element by element, finite, well conditioned and no wider than the box."""
        C = (self._C + self._C.mT) / 2
        sound = all_finite(C)[:, None]  # eigh raises for a whole batch on one NaN
        C = torch.where(sound[..., None], C, torch.eye(C.shape[1], dtype=C.dtype, device=C.device))
        sigma = torch.where(self.sigma.isfinite(), self.sigma, self._start_sigma)
        # No standard deviation above the widest: first by sigma, as far as every coordinate asks for it, then by C.
        room = self._widest / (sigma[:, None] * C.diagonal(dim1=1, dim2=2).clamp(min=0).sqrt())
        common = room.amax(1, keepdim=True).clamp(max=1)
        shrink = (room / common).clamp(max=1)
        C = shrink[:, :, None] * C * shrink[:, None, :]
        sigma, p_c = sigma * common[:, 0], self._p_c * shrink

        values, vectors = eigh(C)
        top = values[:, -1:]
        sound = sound & (top > 0)
        limited = torch.where(sound, torch.maximum(values, top / CONDITION_LIMIT), 1.0)
        scale = torch.where(sound & ((top < SCALE_RANGE[0]) | (top > SCALE_RANGE[1])), top, 1.0)
        rebuilt = product(vectors * limited[:, None], vectors.mT)
        C = torch.where((limited == values).all(1)[:, None, None], C, rebuilt) / scale[..., None]

        self._C, self._root = C, product(vectors * (limited / scale).sqrt()[:, None], vectors.mT)
        self._p_c = torch.where(sound, p_c / scale.sqrt(), 0.0)
        self._p_sigma = torch.where(sound, self._p_sigma, 0.0)
        self.sigma = (sigma * scale[:, 0].sqrt()).clamp(*STEP_RANGE)

    def retain(self, elements: Tensor) -> None:
        """Go on with `elements` [B] (bool) alone; they go on as they would have beside the others."""
        for name in self._state:
            value = getattr(self, name)
            setattr(self, name, None if value is None else value[elements])
        self._generators = [g for g, kept in zip(self._generators, elements.tolist(), strict=True) if kept]

    def state_dict(self) -> dict[str, Any]:
        """All that changes, as plain tensors (copies) and numbers, the generators' states among them."""
        state: dict[str, Any] = {"generation": self.generation}
        for name in self._state:
            value = getattr(self, name)
            state[name.removeprefix("_")] = None if value is None else value.clone()
        state["generators"] = [generator.get_state() for generator in self._generators]
        return state

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue, bit for bit, where `state_dict` was taken by a CMAES of the same settings.

        Raises:
            UserError: if the state does not fit.
        """
        expected = {"generation", "generators"} | {name.removeprefix("_") for name in self._state}
        if set(state) != expected or len(state["generators"]) != len(self._generators):
            raise UserError(
                "CMAES.load_state_dict: this is not the state of a CMAES of as many elements; check the checkpoint"
            )
        B, D = self._m.shape
        offspring = {"_z": (B, self._offspring, D), "_x": (B, self._offspring, D)}  # None between tell and ask
        values = {name: state[name.removeprefix("_")] for name in self._state}
        for name, value in values.items():
            shape = offspring.get(name) or tuple(getattr(self, name).shape)
            fits = name in offspring if value is None else tuple(value.shape) == shape
            if not fits:
                given = "nothing" if value is None else list(value.shape)
                raise UserError(
                    f"CMAES.load_state_dict: {name.removeprefix('_')} is {given}, the settings ask for {list(shape)}"
                )
        for name, value in values.items():
            setattr(self, name, None if value is None else value.to(self._m).clone())
        self.generation = int(state["generation"])
        for generator, saved in zip(self._generators, state["generators"], strict=True):
            generator.set_state(saved.cpu())


def _check(
    mean: Tensor, sigma: float, lower: Tensor, upper: Tensor, generators: int, parents: int, offspring: int
) -> None:
    """Raise UserError for the first setting that is wrong."""
    if offspring < 2:
        raise UserError(f"CMA-ES: offspring must be at least 2, not {offspring}")
    if not 1 <= parents <= offspring:
        raise UserError(f"CMA-ES: parents must be between 1 and offspring = {offspring}, not {parents}")
    if not (sigma > 0 and math.isfinite(sigma)):
        raise UserError(f"CMA-ES: sigma must be a positive number, not {sigma}")
    if mean.ndim != 2 or mean.shape[1] < 1 or lower.shape != mean.shape[1:] or upper.shape != mean.shape[1:]:
        given = f"{list(mean.shape)}, {list(lower.shape)} and {list(upper.shape)}"
        raise UserError(f"CMA-ES: mean must be [B, D], lower and upper [D], not {given}")
    if len(mean) != generators:
        raise UserError(f"CMA-ES: {len(mean)} means need as many generators, not {generators}")
    if not bool((lower < upper).all()):
        raise UserError("CMA-ES: every lower bound must be below its upper bound")
    if not bool((mean.isfinite() & (mean >= lower) & (mean <= upper)).all()):
        raise UserError("CMA-ES: every mean must be finite and inside the box; move it or widen the box")
