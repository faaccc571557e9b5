"""rbfevo: where the control points of an RBF shape deformation should sit, before the design optimization starts."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rbfevo.errors import UserError
    from rbfevo.scoring.deformation import RBFDeformation
    from rbfevo.scoring.evaluator import Evaluator
    from rbfevo.scoring.evolvability import Scores
    from rbfevo.scoring.kernels import Cubic, Kernel, ThinPlate, Wendland, triharmonic, wendland

__all__ = [
    "Cubic",
    "Evaluator",
    "Kernel",
    "RBFDeformation",
    "Scores",
    "ThinPlate",
    "UserError",
    "Wendland",
    "triharmonic",
    "wendland",
]

_MODULES = {
    "scoring.deformation": ("RBFDeformation",),
    "errors": ("UserError",),
    "scoring.evaluator": ("Evaluator",),
    "scoring.evolvability": ("Scores",),
    "scoring.kernels": ("Cubic", "Kernel", "ThinPlate", "Wendland", "triharmonic", "wendland"),
}


def __getattr__(name: str) -> Any:
    """Import on first use: the processes that draw figures need no torch, which takes seconds to import."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(importlib.import_module(f"rbfevo.{module}"), name)
    raise AttributeError(f"module 'rbfevo' has no attribute {name!r}")
