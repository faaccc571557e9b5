"""Ways to find setups: searches for the front or for preferences, and heuristics."""

from rbfevo.methods.blend import BlendHeuristic
from rbfevo.methods.cmaes.search import CmaesSearch
from rbfevo.methods.given import GivenCenters
from rbfevo.methods.gradient.search import GradientSearch
from rbfevo.methods.lloyd import LloydHeuristic
from rbfevo.methods.nsga2 import Nsga2Search
from rbfevo.methods.ols import OlsHeuristic
from rbfevo.methods.panel import Panel
from rbfevo.methods.random import RandomHeuristic

__all__ = [
    "BlendHeuristic",
    "CmaesSearch",
    "GivenCenters",
    "GradientSearch",
    "LloydHeuristic",
    "Nsga2Search",
    "OlsHeuristic",
    "Panel",
    "RandomHeuristic",
]
