"""Populations in slices, which threads share, and whose small matrices stay in cache."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.threads import Result, results_of_slices

if TYPE_CHECKING:
    from rbfevo.scoring.evaluator import Evaluator  # which makes these spectra

BYTES = 1 << 20  # of one m x m matrix of each setup of a slice: a few of these fit a second-level cache


def in_slices(evaluator: Evaluator, work: Callable[[slice], Result], setups: Tensor) -> list[Result]:
    """The results of some work on slices of setups [p, *setup], in order; of all at once with vertices on a GPU."""
    if evaluator.deformation.vertices.is_cuda:
        return [work(slice(0, len(setups)))]
    columns = evaluator.representation.columns(setups)
    return results_of_slices(work, len(setups), max(1, BYTES // (8 * columns * columns)))


class SlicedSpectrum(Spectrum):
    """`Spectrum` of slices of a population."""

    def __init__(self, evaluator: Evaluator, centers: Tensor) -> None:
        """Take centers [p, m, d]; any values."""
        self.evaluator = evaluator
        self._parts = in_slices(evaluator, lambda rows: Spectrum(evaluator, centers[rows]), centers)
        self.centers, self.sigma, self.potentials, self.potential, self.regular, self.improvable = (
            torch.cat([getattr(part, name) for part in self._parts])
            for name in ("centers", "sigma", "potentials", "potential", "regular", "improvable")
        )

    def backward(self, dlog_sigma: Tensor, dpotential: Tensor) -> Tensor:
        """As of `Spectrum`."""
        sizes = [len(part.centers) for part in self._parts]
        given = list(zip(self._parts, dlog_sigma.split(sizes), dpotential.split(sizes), strict=True))
        return torch.cat(results_of_slices(lambda rows: _backward(given[rows]), len(given), 1))


def _backward(given: list[tuple[Spectrum, Tensor, Tensor]]) -> Tensor:
    return torch.cat([part.backward(dlog_sigma, dpotential) for part, dlog_sigma, dpotential in given])
