"""Representations of deformations: how a setup makes the columns of U; one file each, read without torch."""

from rbfevo.scoring.representations.ffd import FFD, ffd
from rbfevo.scoring.representations.kept import beginning_with, keeping
from rbfevo.scoring.representations.rbf import RBF, rbf
from rbfevo.scoring.representations.representation import Pull, Reduced, Representation, Space, representation_of

__all__ = [
    "FFD",
    "RBF",
    "Pull",
    "Reduced",
    "Representation",
    "Space",
    "beginning_with",
    "ffd",
    "keeping",
    "rbf",
    "representation_of",
]
