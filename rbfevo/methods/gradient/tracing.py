"""What a front is traced with: smooth objectives of a spectrum, and where on the front each element has to climb."""

from __future__ import annotations

import abc
from typing import Any

import torch
from torch import Tensor

from rbfevo.scoring.combination import LEAST_RESIDUAL
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.pareto import nondominated, well_spread

LEAST_REGULARITY = 1e-12  # floor of log R, as LEAST_RESIDUAL of log (1 - P): no gradient below
SHARPEST = 64.0  # exponent of the smooth least P: its residual is then at most 1.1 % too small, of two objectives


def climbs(objectives: Tensor) -> Tensor:
    """Objectives [..., 2] (R, P) on the scales that gradients like: (log R, -log(1 - P)), with floors; maximized."""
    residual = (1.0 - objectives[..., 1]).clamp_min(LEAST_RESIDUAL)
    return torch.stack((objectives[..., 0].clamp_min(LEAST_REGULARITY).log(), -residual.log()), dim=-1)


def soft_regularity(spectrum: Spectrum, exponent: Tensor) -> tuple[Tensor, Tensor]:
    """log of a smooth lower bound of R [p], and its gradient [p, m] in log sigma.

    The p-norms (sum sigma^-q)^(-1/q) <= sigma_min and (sum sigma^q)^(1/q) >= sigma_max with q = exponent [p]: smooth
    where singular values coincide, as they do at the maximum of R, and at most m^(2/q) too small.
    """
    log = spectrum.sigma.log()
    q = exponent[:, None]
    value = -(torch.logsumexp(-q * log, 1) + torch.logsumexp(q * log, 1)) / exponent
    slope = torch.softmax(-q * log, 1) - torch.softmax(q * log, 1)
    floor = torch.full_like(value, LEAST_REGULARITY).log()
    climbing = spectrum.regular & (value > floor)
    return torch.where(climbing, value, floor), torch.where(climbing[:, None], slope, 0.0)


def soft_potential(spectrum: Spectrum, sharpness: float) -> tuple[Tensor, Tensor]:
    """The potential [p] to climb on, and its gradient [p, J] in those of the objectives: smooth where it is the least.

    Where two objectives are served equally badly, as they are at the maximum, their least potential has a kink.
    """
    return spectrum.evaluator.combination.smooth(spectrum.potentials, min(sharpness, SHARPEST))


def exponents(regularity: Tensor, sharpness: float) -> Tensor:
    """Exponents q of `soft_regularity` that are as sharp at R near 1, where all singular values lie close together."""
    spread = -regularity.clamp(LEAST_REGULARITY, 1.0).log()
    return sharpness / spread.clamp(1e-4, 1.0)


class Aim(abc.ABC):
    """What each element maximizes, a smooth function of (log R, P)."""

    @abc.abstractmethod
    def __call__(self, log_regularity: Tensor, potential: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Values [p], gradients [p] in log R, and in P."""

    @abc.abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """What it is made of, by name, with the kind of aim; `aim_of` makes it again."""


class WeightedSum(Aim):
    """w log R - (1 - w) log(1 - P) with weights w [p]."""

    def __init__(self, weights: Tensor) -> None:
        self.weights = weights

    def state_dict(self) -> dict[str, Any]:
        """The weights."""
        return {"kind": "weighted sum", "weights": self.weights.clone()}

    def __call__(self, log_regularity: Tensor, potential: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Values, and both gradients."""
        w, residual = self.weights, 1.0 - potential
        climbing = residual > LEAST_RESIDUAL
        residual = residual.clamp_min(LEAST_RESIDUAL)
        value = w * log_regularity - (1.0 - w) * residual.log()
        return value, w, torch.where(climbing, (1.0 - w) / residual, 0.0)


class Tchebycheff(Aim):
    """Outwards from where an element stands on the front: a smooth minimum of what is gained in both objectives.

    -tau log sum_j n_j exp(-(f_j - z_j) / (span_j tau)) of f = (log R, -log(1 - P)): at z it climbs along n, and gaining
    one objective pays the less, the more the other loses. So it holds its place where the front is concave, from which
    every weighted sum would slide away. Source: Lin et al., Smooth Tchebycheff scalarization (ICML 2024), with the
    front's normal as weights.

    Args:
        normals: n [p, 2], not negative, each row of sum 1; (1, 0) and (0, 1) climb in one objective alone.
        span: [2] extent of the front in f.
        tau: how far an element may slide along the front, in extents.
    """

    def __init__(self, normals: Tensor, span: Tensor, tau: float) -> None:
        self.normals, self.span, self.tau = normals.log(), span, tau
        self.origin: Tensor | None = None

    def state_dict(self) -> dict[str, Any]:
        """Normals, extent, tau, and where each element stands."""
        parts = {"log_normals": self.normals.clone(), "span": self.span.clone(), "tau": self.tau}
        return {"kind": "tchebycheff", **parts, "origin": None if self.origin is None else self.origin.clone()}

    def __call__(self, log_regularity: Tensor, potential: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Values, and both gradients; the first call fixes where each element stands."""
        residual = 1.0 - potential
        f = torch.stack((log_regularity, -residual.clamp_min(LEAST_RESIDUAL).log()), dim=1)
        if self.origin is None:
            self.origin = f
        losses = self.normals - (f - self.origin) / (self.span * self.tau)
        slopes = torch.softmax(losses, 1) / self.span
        climbing = residual > LEAST_RESIDUAL
        in_potential = torch.where(climbing, slopes[:, 1] / residual.clamp_min(LEAST_RESIDUAL), 0.0)
        return -self.tau * torch.logsumexp(losses, 1), slopes[:, 0], in_potential


class Preference(Aim):
    """f = preference R + (1 - preference) P (paper, eq. 9) with preferences [p]."""

    def __init__(self, preferences: Tensor) -> None:
        self.preferences = preferences

    def state_dict(self) -> dict[str, Any]:
        """The preferences."""
        return {"kind": "preference", "preferences": self.preferences.clone()}

    def __call__(self, log_regularity: Tensor, potential: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Values, and both gradients."""
        part = self.preferences * log_regularity.exp()
        return part + (1.0 - self.preferences) * potential, part, 1.0 - self.preferences


def aim_of(state: dict[str, Any]) -> Aim:
    """The aim that `state_dict` was taken of."""
    if state["kind"] == "weighted sum":
        return WeightedSum(state["weights"])
    if state["kind"] == "preference":
        return Preference(state["preferences"])
    made = Tchebycheff(torch.ones_like(state["log_normals"]), state["span"], state["tau"])
    made.normals, made.origin = state["log_normals"], state["origin"]  # the logarithm of its exponential is another
    return made


def front_normals(front: Tensor, rows: Tensor, window: float = 0.05) -> tuple[Tensor, Tensor]:
    """Normals [r, 2] of a front [p, 2], sorted by R, at its `rows` [r], and its extent [2] in `climbs`' scales.

    The normal is that of the chord over `window` times the front's length on either side, both axes scaled by extent.
    """
    f = climbs(front)
    span = (f[-1] - f[0]).abs().clamp_min(LEAST_RESIDUAL)
    scaled = f / span
    along = torch.cat((f.new_zeros(1), scaled.diff(dim=0).norm(dim=1).cumsum(0)))
    reach = window * along[-1]
    last = len(front) - 1
    behind = torch.searchsorted(along, along[rows] - reach).clamp(0, last)
    ahead = torch.searchsorted(along, along[rows] + reach).clamp(0, last)
    chord = (scaled[ahead] - scaled[behind]).abs() + 1e-3
    normals = chord.flip(1)
    return normals / normals.sum(1, keepdim=True), span


class Archive:
    """The nondominated setups met so far: points [p, D] and objectives [p, 2] (R, P), sorted by R.

    Beyond `limit` it is thinned out to half of that, so that it keeps most of the hypervolume.

    Attributes:
        elements: [p] which element met each of them.
    """

    def __init__(self, points: Tensor, limit: int) -> None:
        self.limit = max(limit, 4)
        self.points = points[:0]
        self.objectives = points.new_zeros(0, 2)
        self.elements = torch.zeros(0, dtype=torch.long, device=points.device)

    def add(self, points: Tensor, objectives: Tensor, elements: Tensor | None = None) -> None:
        """Take points [k, D] with objectives [k, 2]; what is dominated then is dropped, of duplicates all but one.

        Args:
            elements: [k] which element met each of them; None: element i met point i.
        """
        own = torch.arange(len(points), device=points.device) if elements is None else elements
        points, objectives = torch.cat((self.points, points)), torch.cat((self.objectives, objectives))
        own = torch.cat((self.elements, own))
        rows = nondominated(objectives).nonzero().squeeze(1)
        rows = rows[objectives[rows, 0].argsort(stable=True)]
        first = torch.ones_like(rows, dtype=torch.bool)
        first[1:] = (objectives[rows].diff(dim=0) != 0).any(1)
        rows = rows[first]
        if len(rows) > self.limit:
            rows = rows[well_spread(objectives[rows], self.limit // 2)]
        self.points, self.objectives, self.elements = points[rows], objectives[rows], own[rows]

    def state_dict(self) -> dict[str, Tensor]:
        """Points, objectives and elements; copies."""
        return {name: getattr(self, name).clone() for name in ("points", "objectives", "elements")}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue where `state_dict` was taken."""
        self.points, self.objectives, self.elements = state["points"], state["objectives"], state["elements"]
