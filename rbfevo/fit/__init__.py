"""The design optimization that a setup is made for: an evolution strategy moves the parameters P of X' = X + U P.

Regularity R is meant to predict how fast it converges, improvement potential P how far it gets. The library call is

    fits(scenario, kernel, centers, manipulation="indirect", strategy="isotropic", *, generators, generations=5000,
         within=0.05, smoothness=0.0, parents=25, population=100, optima=None, report=None, stop=None) -> list[Fit]

with centers [B, m, d] of B setups, which run as one batch, and one generator each. `manipulation` is one of
`MANIPULATIONS` (or B of them), `strategy` one of `STRATEGIES`. A `Fit` holds when and why its element stopped, its
errors by generation, its optimum and its parameters [m, k]. An element that cannot be fitted (a singular Psi, a
rank-deficient Phi) returns with the reason and NaNs, and does not affect the others. After every generation
`report(generation, running, ratio)` is called with the number of elements that still run and the largest ratio of error
to optimum among them; all end where `stop()` is true.

`deformation` gives U, R and P of one setup under a manipulation, `Objective` the error and its optimum.
`python -m rbfevo.fit RUN --pick knee` fits a setup of a run directory.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rbfevo.choices import FIT_MANIPULATIONS as MANIPULATIONS
    from rbfevo.choices import FIT_STRATEGIES as STRATEGIES
    from rbfevo.fit.manipulations import Deformation, deformation
    from rbfevo.fit.objective import Objective
    from rbfevo.fit.strategy import Fit, fits

__all__ = ["MANIPULATIONS", "STRATEGIES", "Deformation", "Fit", "Objective", "deformation", "fits"]

_MODULES = {
    "manipulations": ("MANIPULATIONS", "Deformation", "deformation"),
    "objective": ("Objective",),
    "strategy": ("STRATEGIES", "Fit", "fits"),
}


def __getattr__(name: str) -> Any:
    """Import on first use: the command line refuses a mistake before it waits for torch."""
    for module, names in _MODULES.items():
        if name in names:
            return getattr(importlib.import_module(f"rbfevo.fit.{module}"), name)
    raise AttributeError(f"module 'rbfevo.fit' has no attribute {name!r}")
