"""What RBFs with a linear polynomial are made of: the weights of the kernels, and the polynomial."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfevo.arrays import Array
from rbfevo.recorded.setup import Setup
from rbfevo.scoring.representations.linear import LinearRBF


class Morph(NamedTuple):
    """u(x) = sum_j kernel_j phi(|c_j - x|) + constant + slopes^T x, in model units.

    Attributes:
        kernel: [m, k], as `weights` of RBFs alone; polynomial: [1 + d, k], the factors of 1 and of the coordinates.
    """

    kernel: Array
    polynomial: Array


def morph_of(chosen: Setup, weights: Array) -> Morph | None:
    """What the weights [m, k] of a setup make, or None of RBFs alone and of other representations."""
    if not isinstance(chosen.representation, LinearRBF):
        return None
    pair = None if chosen.mirror is None else chosen.representation.symmetric(chosen.mirror)
    kernel, polynomial = np.zeros_like(weights), np.zeros((1 + chosen.centers.shape[1], weights.shape[1]))
    for components, across, columns in chosen.parities(weights.shape[1]):
        if not len(columns):
            continue
        part = chosen.representation if pair is None else pair[1] if across else pair[0]
        cells = np.ix_(columns, components)
        kernel[cells], polynomial[:, components] = part.coefficients(chosen.centers[columns], weights[cells])
    return Morph(kernel, polynomial)
