"""The evaluator where `criterion.norm` is not 2: regularity as ever, and bounded potential in the place of P.

Of several objectives each has a bounded potential of its own, with a best displacement of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rbfevo.scoring.bounded import BoundedPotential
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.evolvability import Scores
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.threads import coarse


class BoundedEvaluator(Evaluator):
    """`Evaluator` whose improvement potential is bounded potential P_p, in scores and in spectra.

    Args:
        plain: the evaluator of the same design for P; it counts.
        bounded: P_p, of several objectives that of each.

    Attributes:
        bounded: P_p of the only objective, or of the first; each: of all of them.
    """

    def __init__(self, plain: Evaluator, bounded: BoundedPotential | Sequence[BoundedPotential]) -> None:
        self.plain, self.combination = plain, plain.combination
        self.each = [bounded] if isinstance(bounded, BoundedPotential) else list(bounded)
        self.bounded = self.each[0]
        self.deformation, self.representation = plain.deformation, plain.representation
        self.gradient, self.weights, self.gram = plain.gradient, plain.weights, plain.gram

    @property
    def evaluations(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As of `plain`."""
        return self.plain.evaluations

    @property
    def failed_evaluations(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As of `plain`."""
        return self.plain.failed_evaluations

    @property
    def gradients(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As of `plain`."""
        return self.plain.gradients

    @property
    def further_passes(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As of `plain`."""
        return self.plain.further_passes

    @property
    def factorizations(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As of `plain`."""
        return self.plain.factorizations

    def definition_of_each(self, centers: Tensor) -> tuple[Scores, Tensor]:
        """Scores [*pop] by the definitions of R and P_p, and P_p [*pop, J] of each objective."""
        return self._with(self.plain.definition(centers), self.exact(centers, by_definition=True))

    def of_each(self, centers: Tensor) -> tuple[Scores, Tensor]:
        """Scores [*pop] of centers [*pop, m, d] with P_p in the place of P, and P_p [*pop, J] of each objective."""
        flat = self._flat(centers)
        found = torch.stack([bounded.values(flat) for bounded in self.each], dim=1)
        return self._with(self.plain(centers), found)

    def exact(self, centers: Tensor, by_definition: bool) -> Tensor:
        """P_p [p, J] of each objective to rounding, by the definition or the fast path; NaN where there is none."""
        flat = self._flat(centers)
        found = [one.definition(flat) if by_definition else one.values(flat, gap=0.0) for one in self.each]
        return torch.stack(found, dim=1)

    def spectrum(self, centers: Tensor, start: Tensor | None = None) -> BoundedSpectrum:
        """Singular values of U and P_p of centers [p, m, d], ready for gradients; start: `near` of a similar one."""
        return BoundedSpectrum(self, centers, start)

    def _flat(self, centers: Tensor) -> Tensor:
        return centers.reshape(-1, *centers.shape[-self.representation.dims :])

    def _with(self, scores: Scores, found: Tensor) -> tuple[Scores, Tensor]:
        """Scores with potentials [p, J], 0 where a setup has none, in the place of P; and these [*pop, J]."""
        found = found.reshape(*scores.regularity.shape, len(self.each))
        lost = scores.failed | ~torch.isfinite(found).all(-1)
        potentials = torch.where(lost[..., None], 0.0, found)
        return scores._replace(improvement_potential=self.combination(potentials)), potentials


class BoundedSpectrum(Spectrum):
    """`Spectrum` with P_p in the place of P.

    Attributes:
        near: [p, s + r k], of several objectives [p, J, s + r k], from where the optima of similar setups are found in
            fewer passes.
    """

    @torch.no_grad()
    @coarse()
    def __init__(self, evaluator: BoundedEvaluator, centers: Tensor, start: Tensor | None = None) -> None:
        """Take centers [p, m, d]; any values."""
        self._plain = plain = evaluator.plain.spectrum(centers)
        self.evaluator, self.centers = evaluator, plain.centers
        self.sigma, self.regular = plain.sigma, plain.regular
        alone = len(evaluator.each) == 1
        starts = [None] * len(evaluator.each) if start is None else [start] if alone else start.unbind(1)
        setups = centers.detach()
        pairs = zip(evaluator.each, starts, strict=True)
        found = [bounded.optima(setups, near, gradients=True) for bounded, near in pairs]
        values = torch.stack([one.values for one in found], dim=1)
        finite = torch.isfinite(values).all(1)
        self.near = found[0].near if alone else torch.stack([one.near for one in found], dim=1)
        self.improvable = plain.improvable & finite
        self.potentials = torch.where(finite[:, None], values, 0.0)
        self.potential = evaluator.combination(self.potentials)
        self._gradients = [one.gradients for one in found]

    @property
    def regularity(self) -> Tensor:
        """R [p], maximized; 0 where there is none."""
        return self._plain.regularity

    @torch.no_grad()
    @coarse()
    def backward(self, dlog_sigma: Tensor, dpotential: Tensor) -> Tensor:
        """Gradient [p, m, d] in the centers of a function with gradients [p, m] in log sigma and [p] in P_p.

        Of several objectives the latter may be those [p, J] in P_p of each.
        """
        gradient = self._plain.backward(dlog_sigma, torch.zeros_like(self.potential))
        if dpotential.ndim == 1:
            dpotential = dpotential[:, None] * self.evaluator.combination.slopes(self.potentials)
        shares = torch.where(self.improvable[:, None], dpotential, 0.0)
        for share, slope in zip(shares.unbind(1), self._gradients, strict=True):
            if slope is not None:
                gradient = gradient + share.view(-1, *(1,) * (gradient.ndim - 1)) * slope
        return gradient
