"""Scores of setups that share most of their centers, such as the first one, two, ... m picks of a nested sequence.

All columns of all setups go through one QR decomposition: with sqrt(w) (Phi g) = Q (T c), the columns of one setup have
the factor T_s, its columns of T. The singular values of Phi_s are those of T_s, those of Phi_s Psi_s^-1 are those of
T_s Psi_s^-1, and P = |V^T c|^2 with the left singular vectors V of T_s whose singular values count. So each setup costs
a decomposition of a small matrix, and is scored as well as by the definition: a Householder QR changes singular values
by rounding alone, as an SVD does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from rbfevo.scoring.bounded import BoundedPotential
from rbfevo.scoring.evaluator import Evaluator
from rbfevo.scoring.evolvability import cutoff
from rbfevo.scoring.representations import Representation
from rbfevo.scoring.symmetric import MirroredEvaluator
from rbfevo.scoring.threads import coarse


class _Block(NamedTuple):
    """Columns of U that share components: place [q] of each center's column in T [r, r], -1 where it has none."""

    representation: Representation
    place: Tensor
    T: Tensor
    c: Tensor


@torch.no_grad()
@coarse()
def shared_scores(evaluator: Evaluator, setups: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """R and P [p] of p setups of RBFs, finite centers [m_i, d] each, by the definition (`scoring.evolvability`)."""
    design = evaluator.deformation.vertices
    every = torch.cat([setup.to(design) for setup in setups])
    if isinstance(evaluator, MirroredEvaluator):
        every = evaluator.mirror.snapped(every)
    centers, index = torch.unique(every, dim=0, return_inverse=True)
    if isinstance(evaluator, MirroredEvaluator):
        off = ~evaluator.mirror.on_plane(centers)
        blocks = [_block(evaluator.along, centers, torch.ones_like(off)), _block(evaluator.across, centers, off)]
    else:
        blocks = [_block(evaluator, centers, torch.ones_like(centers[:, 0], dtype=torch.bool))]
    manipulation = evaluator.deformation.manipulation
    scores = [_scored(blocks, centers, rows, len(design), manipulation) for rows in index.split(list(map(len, setups)))]
    return tuple(torch.tensor(column, dtype=design.dtype) for column in zip(*scores, strict=True))  # pyright: ignore[reportReturnType]


def _block(evaluator: Evaluator, centers: Tensor, has_column: Tensor) -> _Block:
    r = int(has_column.sum())
    place = torch.where(has_column, has_column.cumsum(0) - 1, -1)
    triangle = evaluator.triangle(centers[has_column]) if r else centers.new_zeros(0, 0)
    return _Block(evaluator.representation, place, triangle[:r, :r], triangle[:r, r:])


def _scored(blocks: Sequence[_Block], centers: Tensor, rows: Tensor, n: int, manipulation: str) -> tuple[float, float]:
    """R and P of the setup centers[rows]; R is 0 where the rank is short, or Psi singular under direct manipulation."""
    sigmas, potential, lost = [], 0.0, False
    for block in blocks:
        places = block.place[rows]
        own, T = rows[places >= 0], block.T[:, places[places >= 0]]
        if not len(own):
            continue
        left, sigma, _ = torch.linalg.svd(T, full_matrices=False)
        kept = sigma > cutoff(n, len(own)) * sigma[0]
        potential += float(torch.where(kept[:, None], left.mT @ block.c, 0.0).square().sum())
        lost = lost or not bool(kept.all())
        if manipulation != "indirect" and not lost:
            U = block.representation.matrix(T, centers[own], manipulation)
            lost = U is None
            sigma = sigma if U is None else torch.linalg.svdvals(U)
        sigmas.append(sigma)
    every = torch.cat(sigmas)
    largest = float(every.amax())
    regularity = 0.0 if lost or not largest > 0.0 else float(every.amin()) / largest
    return regularity, min(max(potential, 0.0), 1.0)


@torch.no_grad()
def bounded_prefixes(bounded: BoundedPotential, setups: Sequence[Tensor], picked: Tensor) -> Tensor:
    """P_p [p], to rounding, of setups of the first 1, 2, ... p of centers `picked` [p, d].

    Each begins at the optimum of the one before, which has moved nothing else by its last center.
    """
    values, start = [], None
    for m, setup in enumerate(setups, 1):
        found = bounded.optima(setup[None], start, gap=0.0)
        values.append(found.values[0])
        weights = torch.cat((found.weights[0], found.weights.new_zeros(1, found.weights.shape[2])))
        start = torch.cat((setup, picked[m : m + 1])).flatten() if m < len(picked) else None
        start = None if start is None else torch.cat((start, weights.flatten()))[None]
    return torch.stack(values)
