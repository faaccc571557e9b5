"""Scores of symmetric setups: U is one block for components along the plane, and one for the component across it.

Along the plane column c is phi_c + phi_c', across it phi_c - phi_c' (`rbfevo.geometry.mirror`), where a center on the
plane has no column. Setups that are no centers have the columns that their representation gives them. The parameters
of the m columns move nothing but their own component, so that U is block diagonal: R is the smallest singular value of
both blocks over the largest of both, and P adds up what each block reaches of its own components of g. V is that of the
block along the plane, m/n at best.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from rbfevo.errors import UserError
from rbfevo.geometry.mirror import Mirror
from rbfevo.scenarios.scenario import Scenario
from rbfevo.scoring.combination import ONE, Combination
from rbfevo.scoring.evaluator import Evaluator, Singular
from rbfevo.scoring.evolvability import Scores, projection
from rbfevo.scoring.gradients import Spectrum
from rbfevo.scoring.kernels import Kernel
from rbfevo.scoring.matrices import all_finite
from rbfevo.scoring.representations import RBF, Representation
from rbfevo.scoring.threads import coarse, run_in_slices


class MirroredEvaluator(Evaluator):
    """`Evaluator` of a design that stays symmetric: m centers on one side stand for themselves and their images.

    Args:
        mirror: the plane; the others are those of `Evaluator`, with g [n, d] in space, of J objectives [n, J d].

    Raises:
        UserError: if g has not one component for every axis, so that it has none across the plane.
    """

    def __init__(
        self,
        vertices: Tensor,
        gradient: Tensor,
        kernel: Kernel | Representation,
        manipulation: str = "indirect",
        weights: Tensor | None = None,
        backend: str = "auto",
        block: int | None = None,
        blend: Tensor | None = None,
        combination: Combination = ONE,
        *,
        mirror: Mirror,
    ) -> None:
        d = vertices.shape[1]
        if gradient.shape[1] != d * combination.count:
            raise UserError("symmetry needs a wanted displacement with three components")
        self.mirror, self.combination = mirror, combination
        self.gradient = gradient
        self.weights = torch.ones_like(vertices[:, 0]) if weights is None else weights
        across = [column for column in range(gradient.shape[1]) if column % d == mirror.axis]
        along = [column for column in range(gradient.shape[1]) if column % d != mirror.axis]
        whole = RBF(kernel) if isinstance(kernel, Kernel) else kernel
        pair = whole.symmetric(mirror)
        if pair is None:
            raise UserError(f"scenario.symmetry: representation={whole.name} has no symmetric setups")
        self.along, self.across = (
            Evaluator(vertices, gradient[:, axes], part, manipulation, weights, backend, block, blend, combination)
            for axes, part in zip((along, across), pair, strict=True)
        )
        self.deformation, self.representation = self.along.deformation, self.along.representation
        self.gram = self.along.gram
        self.evaluations = self.failed_evaluations = self.gradients = 0

    @property
    def further_passes(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Of both blocks."""
        return self.along.further_passes + self.across.further_passes

    @property
    def factorizations(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Of both blocks."""
        return self.along.factorizations + self.across.factorizations

    def definition_of_each(self, centers: Tensor) -> tuple[Scores, Tensor]:
        """Scores [*pop] of centers [*pop, m, d] by the definition, and P [*pop, J] of each objective; the reference."""
        dims = self.representation.dims
        flat = centers.detach().reshape(-1, *centers.shape[-dims:]).to(self.deformation.vertices.device)
        columns = torch.zeros(3 + self.combination.count, len(flat), dtype=centers.dtype, device=flat.device)

        def work(begin: int, end: int) -> None:
            for i in range(begin, end):
                columns[:, i] = self._define(flat[i])

        run_in_slices(work, len(flat))
        regularity, variability, failed, *each = columns.to(centers.device).reshape(
            len(columns), *centers.shape[:-dims]
        )
        potentials = torch.stack(each, dim=-1)
        return Scores(regularity, self.combination(potentials), variability, failed > 0), potentials

    def _define(self, setup: Tensor) -> Tensor:
        """R, V, whether the setup has failed, and P of each objective."""
        failure = setup.new_tensor([0.0, 0.0, 1.0, *[0.0] * self.combination.count])
        if not bool(torch.isfinite(setup).all()):
            return failure
        setup = self.snapped(setup)
        free = setup[~self.mirror.on_plane(setup)] if self.representation.dims == 2 else setup
        rank, residuals, lost, sigmas = 0, setup.new_zeros(self.combination.count), False, []
        for part, centers in ((self.along, setup), (self.across, free)):
            roots = self.weights.sqrt()[:, None]
            if not len(centers) or not part.representation.columns(centers):
                residuals = residuals + self.combination.norms(roots * part.gradient)
                continue
            Phi = part.deformation.phi(centers)
            if not bool(torch.isfinite(Phi).all()):
                return failure
            direct = self.deformation.manipulation != "indirect"
            narrow = (
                part.representation.matrix(Phi, centers, "direct") if direct and part.representation.narrows else None
            )
            reached = Phi if narrow is None else narrow
            sigma, kept, left = projection(reached, part.gradient, self.weights, self.combination)
            residuals, lost = residuals + left, lost or not bool(kept.all())
            rank = int(kept.sum()) if part is self.along else rank
            if direct and narrow is None and not lost:
                U = part.representation.matrix(Phi, centers, self.deformation.manipulation)
                sigma = torch.ones_like(Phi[0]) if U is None else torch.linalg.svdvals(roots * U)
                lost = lost or U is None
            sigmas.append(sigma)
        every = torch.cat(sigmas)
        regularity = 0.0 if lost or not bool(every.amax() > 0) else float(every.amin() / every.amax())
        each = [min(max(1.0 - residual, 0.0), 1.0) for residual in residuals.tolist()]
        scores = setup.new_tensor([regularity, rank / len(self.weights), 0.0, *each])
        return scores if bool(torch.isfinite(scores).all()) else failure

    def spectrum(self, centers: Tensor) -> MirroredSpectrum:
        """Singular values and P of both blocks of centers [p, m, d], ready for gradients."""
        return MirroredSpectrum(self, centers)

    def singular(self, setups: Tensor, finite: Tensor) -> Singular:
        """Extreme singular values of both blocks, the sum of their P, and the rank of the block along the plane."""
        setups = self.snapped(setups)
        largest, smallest, lost, potentials, rank, usable = self.along.singular(setups, finite)
        for rows, centers in self.off_plane(setups):
            part = self.across.singular(centers, finite[rows])
            largest[rows] = torch.maximum(largest[rows], part.largest)
            smallest[rows] = torch.minimum(smallest[rows], part.smallest)
            lost[rows] |= part.lost
            potentials[rows] += torch.where(part.usable[:, None], part.potentials, 0.0)
            usable[rows] &= part.usable
        return Singular(largest, smallest, lost, potentials, rank, usable)

    def snapped(self, setups: Tensor) -> Tensor:
        """Setups [*pop, *setup], centers on the plane exactly on it."""
        return self.mirror.snapped(setups) if self.representation.dims == 2 else setups

    def off_plane(self, setups: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """The setups [p, m, d] that have centers off the plane, in groups of equally many: rows [q], centers [q, f, d].

        The f centers keep their order. Setups that are no centers come whole, where they have columns across the plane.
        """
        if self.representation.dims != 2:
            if self.across.representation.columns(setups):
                yield torch.arange(len(setups), device=setups.device), setups
            return
        off = ~self.mirror.on_plane(setups)
        for count in off.sum(1).unique().tolist():
            if count:
                rows = torch.nonzero(off.sum(1) == count).flatten()
                yield rows, setups[rows][off[rows]].unflatten(0, (len(rows), count))


class MirroredSpectrum(Spectrum):
    """`Spectrum` of both blocks.

    Attributes:
        sigma: [p, 2m], in no order: those along the plane, and those across it. A setup with fewer of these has some
            in their place that lie between its extremes.
    """

    @torch.no_grad()
    @coarse()
    def __init__(self, evaluator: MirroredEvaluator, centers: Tensor) -> None:
        """Take centers [p, m, d]; any values."""
        finite = all_finite(centers)
        kept = finite.view(-1, *(1,) * (centers.ndim - 1))
        snapped = evaluator.snapped(torch.where(kept, centers.detach(), 0.0))
        self.evaluator, self.centers = evaluator, snapped
        self._off = ~evaluator.mirror.on_plane(snapped) if evaluator.representation.dims == 2 else None
        self._along = along = evaluator.along.spectrum(torch.where(kept, snapped, torch.nan))
        self._groups: list[tuple[Tensor, Spectrum]] = []
        self.regular, self.improvable = along.regular.clone(), along.improvable.clone()
        self.potentials = along.potentials.clone()
        across = torch.zeros_like(along.sigma)
        for rows, free in evaluator.off_plane(snapped):
            part = evaluator.across.spectrum(torch.where(kept[rows], free, torch.nan))
            self._groups.append((rows, part))
            across[rows, : part.sigma.shape[1]] = part.sigma
            self.regular[rows] &= part.regular
            self.improvable[rows] &= part.improvable
            self.potentials[rows] += part.potentials
        self.potentials.clamp_(0.0, 1.0)
        self.potential = evaluator.combination(self.potentials)
        lowest = torch.where(across > 0, across, torch.inf).amin(1).minimum(along.sigma.amin(1))
        middle = (lowest * across.amax(1).maximum(along.sigma.amax(1))).sqrt()
        filled = torch.where(across > 0, across, middle[:, None])
        self.sigma = torch.where(self.regular[:, None], torch.cat((along.sigma, filled), dim=1), 1.0)
        evaluator.count(evaluations=len(centers), failed_evaluations=int((~finite).sum()))

    @property
    def regularity(self) -> Tensor:
        """R [p], maximized; 0 where there is none."""
        return torch.where(self.regular, self.sigma.amin(1) / self.sigma.amax(1), 0.0)

    @torch.no_grad()
    @coarse()
    def backward(self, dlog_sigma: Tensor, dpotential: Tensor) -> Tensor:
        """Gradient [p, m, d] in the centers of a function with gradients [p, 2m] in log sigma, and in P as there."""
        m = self._along.sigma.shape[1]
        self.evaluator.count(gradients=len(self.centers))
        dlog_sigma = torch.where(self.regular[:, None], dlog_sigma, 0.0)
        if dpotential.ndim == 1:  # which of the objectives is the active one is decided by both blocks together
            dpotential = dpotential[:, None] * self.evaluator.combination.slopes(self.potentials)
        dpotential = torch.where(self.improvable[:, None], dpotential, 0.0)
        gradient = self._along.backward(dlog_sigma[:, :m], dpotential)
        for rows, part in self._groups:
            free = part.sigma.shape[1]
            found = part.backward(dlog_sigma[rows, m : m + free], dpotential[rows])
            if self._off is None:
                gradient[rows] += found
                continue
            here = gradient[rows]
            here[self._off[rows]] += found.flatten(0, 1)
            gradient[rows] = here
        return gradient


def evaluator_of(
    scenario: Scenario, kernel: Kernel | Representation, manipulation: str, backend: str = "auto"
) -> Evaluator:
    """The evaluator of a scenario's design, of symmetric setups where the scenario is symmetric.

    Raises:
        UserError: if the representation has no symmetric setups, or no planar ones, where they are asked for.
    """
    if scenario.planar is not None and not isinstance(kernel, Kernel | RBF):
        raise UserError(f"scenario.planar={scenario.planar.name}: representation={kernel.name} has no planar setups")
    design = (scenario.vertices, scenario.gradient, kernel, manipulation, scenario.weights, backend)
    more = {"blend": scenario.blend, "combination": Combination.of(scenario.objectives)}
    if scenario.mirror is None:
        return Evaluator(*design, **more)
    return MirroredEvaluator(*design, **more, mirror=scenario.mirror)
