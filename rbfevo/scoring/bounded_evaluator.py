"""The evaluator where `criterion.norm` is not 2: regularity as ever, and bounded potential in the place of P."""

from __future__ import annotations

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
        bounded: P_p.
    """

    def __init__(self, plain: Evaluator, bounded: BoundedPotential) -> None:
        self.plain, self.bounded = plain, bounded
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

    def definition(self, centers: Tensor) -> Scores:
        """Scores [*pop] by the definitions of R and P_p."""
        return self._with(self.plain.definition(centers), self.bounded.definition(self._flat(centers)))

    def __call__(self, centers: Tensor) -> Scores:
        """Scores [*pop] of centers [*pop, m, d] with P_p in the place of P; as `Evaluator`."""
        return self._with(self.plain(centers), self.bounded.values(self._flat(centers)))

    def spectrum(self, centers: Tensor, start: Tensor | None = None) -> BoundedSpectrum:
        """Singular values of U and P_p of centers [p, m, d], ready for gradients; start: `near` of a similar one."""
        return BoundedSpectrum(self, centers, start)

    def _flat(self, centers: Tensor) -> Tensor:
        return centers.reshape(-1, *centers.shape[-self.representation.dims :])

    @staticmethod
    def _with(scores: Scores, potential: Tensor) -> Scores:
        potential = potential.reshape(scores.regularity.shape)
        lost = scores.failed | ~torch.isfinite(potential)
        return scores._replace(improvement_potential=torch.where(lost, 0.0, potential))


class BoundedSpectrum(Spectrum):
    """`Spectrum` with P_p in the place of P.

    Attributes:
        near: [p, s + r k] from where the optima of similar setups are found in fewer passes.
    """

    @torch.no_grad()
    @coarse()
    def __init__(self, evaluator: BoundedEvaluator, centers: Tensor, start: Tensor | None = None) -> None:
        """Take centers [p, m, d]; any values."""
        self._plain = plain = evaluator.plain.spectrum(centers)
        self.evaluator, self.centers = evaluator, plain.centers
        self.sigma, self.regular = plain.sigma, plain.regular
        found = evaluator.bounded.optima(centers.detach(), start, gradients=True)
        finite = torch.isfinite(found.values)
        self.near = found.near
        self.improvable = plain.improvable & finite
        self.potential = torch.where(finite, found.values, 0.0)
        self._gradients = found.gradients

    @property
    def regularity(self) -> Tensor:
        """R [p], maximized; 0 where there is none."""
        return self._plain.regularity

    @torch.no_grad()
    @coarse()
    def backward(self, dlog_sigma: Tensor, dpotential: Tensor) -> Tensor:
        """Gradient [p, m, d] in the centers of a function with gradients [p, m] in log sigma and [p] in P_p."""
        gradient = self._plain.backward(dlog_sigma, torch.zeros_like(dpotential))
        if self._gradients is None:
            return gradient
        share = torch.where(self.improvable, dpotential, 0.0).view(-1, *(1,) * (gradient.ndim - 1))
        return gradient + share * self._gradients
