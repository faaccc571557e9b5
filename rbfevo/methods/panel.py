"""One panel of the paper: several methods, one after the other, and the blend of two of them."""

from __future__ import annotations

from rbfevo.methods.cmaes.search import CmaesSearch
from rbfevo.methods.method import Method


class Panel:
    """One panel of the paper's figures 3 and 6: front, preference grid, Lloyd and OLS, one after the other.

    The paper left setups between Lloyd and OLS as future work: those of `blend`, unless it is None, come last.
    """

    name = "panel"

    def __init__(
        self, nsga2: Method, cmaes: CmaesSearch, lloyd: Method, ols: Method, blend: Method | None = None
    ) -> None:
        cmaes.default_preferences = tuple(i / 10 for i in range(11))
        self.stages: list[Method] = [nsga2, cmaes, lloyd, ols, *([] if blend is None else [blend])]
