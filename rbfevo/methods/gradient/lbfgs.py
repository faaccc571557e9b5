"""Limited-memory BFGS for many maximizations at once, each inside the unit box."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

ARMIJO = 1e-4
SHRINK = 0.3
LONGEST = 0.3  # of a step, Euclidean, in units of the box
REJECTIONS = 8  # in a row, after which the memory is forgotten
ROWS = (
    "points",
    "values",
    "_gradients",
    "_direction",
    "_length",
    "_rejected",
    "_scale",
    "_trial",
    "accepted",
)  # [K, ...]
PAIRS = ("_steps", "_changes", "_rho")  # [memory, K, ...]
STATE = (*ROWS, *PAIRS)


class LBFGS:
    """K independent maximizations by ask and tell: projected L-BFGS steps, backtracking until Armijo's condition holds.

    An element's path depends on nothing but its own values. Source: Nocedal 1980 (two-loop recursion); variables at a
    bound that the gradient pushes outwards stay there, in the manner of Bertsekas 1982.

    Args:
        points: [K, D] start, inside [0, 1].
        memory: calls of `tell` whose pairs of a step and a gradient change are kept.
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
        self._slot = 0  # where the next pair goes
        self._scale = points.new_zeros(K)  # of the inverse Hessian before any pair, from the last one; 0 without one
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
        self._forget(rows)
        self._rejected[rows] = 0
        self.put(rows, points)

    def put(self, rows: Tensor, points: Tensor) -> None:
        """Put elements `rows` [k] at new points [k, D], with the memory that they have."""
        self.points[rows] = points
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
        kept._slot = self._slot
        return kept

    def anew(self, points: Tensor) -> LBFGS:
        """The same method on other points [k, D], without memory."""
        return LBFGS(points, len(self._rho), self.first)

    def state_dict(self) -> dict[str, Any]:
        """All that changes, as tensors by name, and the slot of the next pair; copies."""
        return {name: getattr(self, name).clone() for name in STATE} | {"slot": self._slot}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue, bit for bit, where `state_dict` was taken; the number of elements is that of the state."""
        for name in STATE:
            setattr(self, name, state[name].to(getattr(self, name)).clone())
        self._slot = int(state["slot"])

    def accepts(self, values: Tensor) -> Tensor:
        """Whether the points last asked for are accepted [K] with these values [K]; only those need gradients."""
        gain = torch.linalg.vecdot(self._gradients, self._trial - self.points)
        return torch.isinf(self.values) | (values >= self.values + ARMIJO * gain)

    def tell(self, values: Tensor, gradients: Tensor) -> None:
        """Take values [K] (maximized) and gradients [K, D] of the points last asked for; NaN is a rejection.

        Gradients of points that are not accepted are not looked at.
        """
        move = self._trial - self.points
        fresh = torch.isinf(self.values)
        self.accepted = accepted = self.accepts(values)
        gradients = torch.where(accepted[:, None], gradients, self._gradients)
        self._remember(accepted & ~fresh, move, self._gradients - gradients)  # change of the gradient of -f
        self.points = torch.where(accepted[:, None], self._trial, self.points)
        self._gradients = gradients
        self.values = torch.where(accepted, values, self.values)
        self._rejected = torch.where(accepted, 0, self._rejected + 1)
        stuck = self._rejected >= REJECTIONS
        self._forget(stuck)
        self._rejected = torch.where(stuck, 0, self._rejected)
        turned = accepted | stuck
        self._direction = torch.where(turned[:, None], self._ascent(), self._direction)
        self._length = torch.where(turned, 1.0, SHRINK * self._length)
        self._trial = (self.points + self._length[:, None] * self._direction).clamp(0.0, 1.0)

    def _remember(self, taken: Tensor, move: Tensor, change: Tensor) -> None:
        """Keep the pair of each element whose step was taken [K] and curves upwards; no pair of the others."""
        curvature, square = torch.linalg.vecdot(move, change), torch.linalg.vecdot(change, change)
        useful = taken & (curvature > 1e-10 * square)
        self._steps[self._slot] = torch.where(useful[:, None], move, 0.0)
        self._changes[self._slot] = torch.where(useful[:, None], change, 0.0)
        self._rho[self._slot] = torch.where(useful, 1.0 / torch.where(useful, curvature, 1.0), 0.0)
        self._scale = torch.where(useful, curvature / torch.where(useful, square, 1.0), self._scale)
        self._slot = (self._slot + 1) % len(self._rho)

    def _forget(self, which: Tensor) -> None:
        self._rho[:, which] = 0.0
        self._scale[which] = 0.0

    def _ascent(self) -> Tensor:
        """[K, D] directions: the two-loop recursion on the free variables, the gradient where that does not ascend."""
        held = ((self.points <= 0.0) & (self._gradients < 0.0)) | ((self.points >= 1.0) & (self._gradients > 0.0))
        gradient = torch.where(held, 0.0, self._gradients)
        tiny = torch.finfo(gradient.dtype).tiny
        steepest = gradient * (self.first / gradient.norm(dim=1).clamp_min(tiny))[:, None]
        q = gradient
        order = [(self._slot + age) % len(self._rho) for age in range(len(self._rho))]  # the oldest first
        pairs = [(self._steps[slot], self._changes[slot], self._rho[slot, :, None]) for slot in order]
        alphas = []
        for step, change, rho in reversed(pairs):
            alphas.append(rho * torch.linalg.vecdot(step, q)[:, None])
            q = torch.addcmul(q, alphas[-1], change, value=-1.0)
        q = torch.where((self._scale > 0)[:, None], self._scale[:, None] * q, steepest)
        for (step, change, rho), alpha in zip(pairs, reversed(alphas), strict=True):
            q = torch.addcmul(q, alpha - rho * torch.linalg.vecdot(change, q)[:, None], step)
        q = torch.where(held, 0.0, q)
        downhill = ~(torch.linalg.vecdot(q, gradient) > 0.0)
        self._forget(downhill)
        q = torch.where(downhill[:, None], steepest, q)
        return q * (LONGEST / q.norm(dim=1).clamp_min(LONGEST))[:, None]
