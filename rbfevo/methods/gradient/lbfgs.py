"""Limited-memory BFGS for many maximizations at once, each inside the unit box."""

from __future__ import annotations

import math

import torch
from torch import Tensor

ARMIJO = 1e-4
SHRINK = 0.3
LONGEST = 0.3  # of a step, Euclidean, in units of the box
REJECTIONS = 8  # in a row, after which the memory is forgotten
ROWS = ("points", "values", "_gradients", "_direction", "_length", "_rejected", "_trial", "accepted")  # [K, ...]
PAIRS = ("_steps", "_changes", "_rho")  # [memory, K, ...]
STATE = (*ROWS, *PAIRS)


class LBFGS:
    """K independent maximizations by ask and tell: projected L-BFGS steps, backtracking until Armijo's condition holds.

    An element's path depends on nothing but its own values. Source: Nocedal 1980 (two-loop recursion); variables at a
    bound that the gradient pushes outwards stay there, in the manner of Bertsekas 1982.

    Args:
        points: [K, D] start, inside [0, 1].
        memory: pairs of steps and gradient changes that are kept.
        first: Euclidean length of a first step along the gradient.

    Attributes:
        points: [K, D] the last accepted ones; values: [K] theirs, maximized, -inf before the first `tell`.
        accepted: [K] whether the last `tell` was of an accepted point.
    """

    def __init__(self, points: Tensor, memory: int = 20, first: float = 0.01) -> None:
        K, D = points.shape
        self.first = first
        self.points = points.clone()
        self.values = points.new_full((K,), -math.inf)
        self._gradients = torch.zeros_like(self.points)
        self._steps = points.new_zeros(memory, K, D)
        self._changes = points.new_zeros(memory, K, D)
        self._rho = points.new_zeros(memory, K)  # 1 / (step . change); 0 where a pair is missing
        self._direction = torch.zeros_like(self.points)
        self._length = points.new_ones(K)
        self._rejected = torch.zeros(K, dtype=torch.long, device=points.device)
        self._trial = self.points.clone()
        self.accepted = torch.zeros(K, dtype=torch.bool, device=points.device)

    def ask(self) -> Tensor:
        """[K, D] the points to evaluate next."""
        return self._trial

    def restart(self, rows: Tensor, points: Tensor) -> None:
        """Put elements `rows` [k] at new points [k, D], without memory."""
        self.points[rows] = points
        self._rho[:, rows] = 0.0
        self._rejected[rows] = 0
        self.revalue()

    def revalue(self) -> None:
        """The objectives have changed: every element is evaluated where it stands; memory is kept."""
        self.values = torch.full_like(self.values, -math.inf)
        self._trial = self.points.clone()

    def only(self, rows: Tensor) -> LBFGS:
        """Elements `rows` [k] alone, with their memory."""
        kept = LBFGS(self.points[rows], len(self._rho), self.first)
        for name in ROWS[1:]:
            setattr(kept, name, getattr(self, name)[rows])
        for name in PAIRS:
            setattr(kept, name, getattr(self, name)[:, rows])
        return kept

    def anew(self, points: Tensor) -> LBFGS:
        """The same method on other points [k, D], without memory."""
        return LBFGS(points, len(self._rho), self.first)

    def state_dict(self) -> dict[str, Tensor]:
        """All that changes, as tensors by name; copies."""
        return {name: getattr(self, name).clone() for name in STATE}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue, bit for bit, where `state_dict` was taken; the number of elements is that of the state."""
        for name in STATE:
            setattr(self, name, state[name].to(getattr(self, name)).clone())

    def tell(self, values: Tensor, gradients: Tensor) -> None:
        """Take values [K] (maximized) and gradients [K, D] of the points last asked for; NaN is a rejection."""
        move = self._trial - self.points
        fresh = torch.isinf(self.values)
        accepted = fresh | (values >= self.values + ARMIJO * (self._gradients * move).sum(1))
        change = self._gradients - gradients  # of the gradient of -f
        curvature = (move * change).sum(1)
        self.accepted = accepted
        useful = accepted & ~fresh & (curvature > 1e-10 * change.square().sum(1))
        self._remember(useful, move, change, curvature)
        self.points = torch.where(accepted[:, None], self._trial, self.points)
        self._gradients = torch.where(accepted[:, None], gradients, self._gradients)
        self.values = torch.where(accepted, values, self.values)
        self._rejected = torch.where(accepted, 0, self._rejected + 1)
        stuck = self._rejected >= REJECTIONS
        self._rho = torch.where(stuck, 0.0, self._rho)
        self._rejected = torch.where(stuck, 0, self._rejected)
        turned = accepted | stuck
        self._direction = torch.where(turned[:, None], self._ascent(), self._direction)
        self._length = torch.where(turned, 1.0, SHRINK * self._length)
        self._trial = (self.points + self._length[:, None] * self._direction).clamp(0.0, 1.0)

    def _remember(self, useful: Tensor, move: Tensor, change: Tensor, curvature: Tensor) -> None:
        rows = useful[:, None]
        self._steps = torch.where(rows, torch.cat((self._steps[1:], move[None])), self._steps)
        self._changes = torch.where(rows, torch.cat((self._changes[1:], change[None])), self._changes)
        rho = 1.0 / torch.where(useful, curvature, 1.0)
        self._rho = torch.where(useful, torch.cat((self._rho[1:], rho[None])), self._rho)

    def _ascent(self) -> Tensor:
        """[K, D] directions: the two-loop recursion on the free variables, the gradient where that does not ascend."""
        held = ((self.points <= 0.0) & (self._gradients < 0.0)) | ((self.points >= 1.0) & (self._gradients > 0.0))
        gradient = torch.where(held, 0.0, self._gradients)
        tiny = torch.finfo(gradient.dtype).tiny
        steepest = gradient * (self.first / gradient.norm(dim=1).clamp_min(tiny))[:, None]
        q = gradient
        pairs = list(zip(self._steps, self._changes, self._rho, strict=True))
        alphas = []
        for step, change, rho in reversed(pairs):
            alphas.append(rho * (step * q).sum(1))
            q = q - alphas[-1][:, None] * change
        last = self._rho[-1]
        scale = 1.0 / (last * self._changes[-1].square().sum(1)).clamp_min(tiny)
        q = torch.where((last > 0)[:, None], scale[:, None] * q, steepest)
        for (step, change, rho), alpha in zip(pairs, reversed(alphas), strict=True):
            q = q + (alpha - rho * (change * q).sum(1))[:, None] * step
        q = torch.where(held, 0.0, q)
        downhill = ~((q * gradient).sum(1) > 0.0)
        self._rho = torch.where(downhill, 0.0, self._rho)
        q = torch.where(downhill[:, None], steepest, q)
        return q * (LONGEST / q.norm(dim=1).clamp_min(LONGEST))[:, None]
